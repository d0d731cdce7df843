"""What a fit's own parameters and start states leave of a column, so that what it adds can be judged by itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.statistics import times

Array = NDArray[np.float64]


class Projection:
    """The fit's own parameters and start states, projected out of columns and residuals."""

    def __init__(self, fitter: Fitter, fit: Fit) -> None:
        precision, pull, low, high = fit.prior()
        q, starts = fit.quadratic(fitter.spread)
        g, S = q.weighted(fit.weight)
        slope = g + pull
        pinned = ((low >= -1e-12) & (slope < 0)) | ((high <= 1e-12) & (slope > 0))
        self.free = np.flatnonzero(~pinned)
        self.fit, self.starts, self.root = fit, starts, np.sqrt(fit.weight)[:, None]
        H = (S + np.diag(precision))[np.ix_(self.free, self.free)]
        self.inverse = np.linalg.pinv(H) if len(self.free) else H
        self.slope = slope[self.free]
        self.A = fit.A[:, :, self.free]
        self.Bt, self.BA = starts.B.mT, starts.B.mT @ self.A
        # columns by the parameters as one matrix, weighted, and less what the start states take
        rows = self.A.shape[0] * self.A.shape[1]  # there may be no parameter that is free
        self.away = (self.A - starts.B @ (starts.M @ self.BA)).reshape(rows, len(self.free))
        self.weighted = np.repeat(fit.weight, self.A.shape[1])[:, None] * self.away

    def moments(self, a: Array) -> tuple[float, float, float, Array]:
        """(s, g, full norm, projected column) of a column `[W, n]`."""
        w, starts = self.fit.weight, self.starts
        Ba = times(self.Bt, a)
        MBa = times(starts.M, Ba)
        s_aa = float(w @ (np.sum(a * a, 1) - np.sum(Ba * MBa, 1)))
        g_a = float(w @ (np.sum(a * self.fit.r, 1) - np.sum(MBa * starts.b, 1)))
        s_ab = self.weighted.T @ a.ravel()
        along = self.inverse @ s_ab
        projected = a - times(starts.B, MBa) - (self.away @ along).reshape(a.shape)
        return s_aa - float(s_ab @ along), g_a - float(s_ab @ (self.inverse @ self.slope)), s_aa, projected * self.root

    def taken(self, a: Array, share: float) -> Array | None:
        """Steps `[k]` of the fit's numbers that do the work of a column `[W, n]`; None where they do less of it."""
        w = self.fit.weight
        MBa = times(self.starts.M, times(self.Bt, a))
        s_ab = self.weighted.T @ a.ravel()
        along = self.inverse @ s_ab
        s_aa = float(w @ (np.sum(a * a, 1) - np.sum(times(self.Bt, a) * MBa, 1)))
        if s_aa <= 0 or float(s_ab @ along) <= share * s_aa:
            return None
        steps = np.zeros(self.fit.A.shape[2])
        steps[self.free] = along
        return steps
