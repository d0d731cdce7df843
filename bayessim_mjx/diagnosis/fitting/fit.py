"""A model fitted so far, as a value; how its columns are corrected without a simulation, and when it rests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import SURE
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.quadratic import RULES, Quadratic, Starts, eliminate

Array = NDArray[np.float64]
REACH = 16.0  # by which its step may be longer or shorter than the first one (`candidates.STEP`); not counted


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted so far.

    Attributes:
        coordinates: free ones; values: `[k]`; offsets: `[W, s]` of the start states.
        r: whitened residuals `[W, n]`; A: `[W, n, k]`, minus their derivatives; B: `[W, n, s]` by the start states.
        weight: `[W]`; cost: weighted, priors included; damping: Levenberg's, of the next
            step.
        promise: by how much the next step would lower the cost if the model were linear; history: costs, step by step.
        doubt: squared misfit per independent number in the data, by which priors of stated parameters are multiplied.
        reach: `[W]`, share of their own steps that the start states make: less after one that did a window harm.
        spread: `[s]`, standard deviations of the start states' prior; those of motors are learnt (`learnt_spread`).
        inferred: {kind: factor of its priors' precision} where the data sheet's accuracy was inferred (`accuracy`).
    """

    coordinates: tuple[Coordinate, ...]
    values: Array
    offsets: Array
    r: Array
    A: Array
    B: Array
    weight: Array
    cost: float
    damping: float = RULES.trust
    promise: float = np.inf
    history: tuple[float, ...] = ()
    doubt: float = 1.0
    reach: Array = field(default_factory=lambda: np.ones(1))
    spread: Array = field(default_factory=lambda: np.ones(1))
    inferred: Mapping[str, float] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coordinates)

    @property
    def away(self) -> Array:
        """Distance of its numbers from neutral `[k]`: from the data sheet, from no effect."""
        return np.asarray(self.values - np.array([c.neutral for c in self.coordinates]))

    @property
    def usual(self) -> Array:
        """Steps `[k]` of finite differences where nothing is known of the columns."""
        return np.array([c.step for c in self.coordinates])

    def steps(self) -> Array:
        """Of the columns' finite differences `[k]`: of a motion changed by `RULES.change`, going by the last ones.

        Numbers that do the same to the motion then have the same columns, but for a factor. A secant's own error (its
        second order, where friction sticks) would else tell them apart.
        """
        own = self.usual
        if self.A.shape != (*self.r.shape, len(own)):
            return own
        size = np.sqrt(np.mean(self.A**2, axis=(0, 1)))
        return np.clip(np.divide(RULES.change, size, where=size > 0, out=own.copy()), own / REACH, own * REACH)

    def inward(self, values: Array, steps: Array) -> Array:
        """Turn steps down where ranges end above."""
        return np.where(values + steps <= [c.high for c in self.coordinates], steps, -steps)

    def trust(self) -> Array:
        """Factors `[k]` of the priors' precisions: 1, but where an accuracy is inferred (`Coordinate.kind`).

        The prior of all parameters of a kind is a multivariate Student t: their common variance has a scaled inverse
        chi-squared prior (`data_sheet.SURE`), and its precision's mean given n parameters is (SURE + n) / (SURE + off).
        It is never above 1: parameters that no data move would otherwise vouch for each other's accuracy.
        """
        off = self._off(self.values)
        factor = self.inferred or {kind: min(1.0, (SURE + n) / (SURE + far)) for kind, (far, n) in off.items()}
        return np.array([factor.get(c.kind, 1.0) for c in self.coordinates])

    def _off(self, values: Array) -> dict[str, tuple[float, int]]:
        """{kind: (squared standard deviations by which its parameters are off, in sum; how many those are)}."""
        out: dict[str, tuple[float, int]] = {}
        for c, v in zip(self.coordinates, values, strict=True):
            if c.kind:
                far, n = out.get(c.kind, (0.0, 0))
                out[c.kind] = far + float(c.precision * (v - c.neutral) ** 2), n + 1
        return out

    def prior(self) -> tuple[Array, Array, Array, Array]:
        """(precision, pull, room below, room above), `[k]` each, in units of the cost."""
        precision = self.belief() * np.array([self.doubt if c.stated else 1.0 for c in self.coordinates])
        low = np.array([c.low for c in self.coordinates]) - self.values
        high = np.array([c.high for c in self.coordinates]) - self.values
        return precision, -precision * self.away, low, high

    def belief(self) -> Array:
        """Precision of the priors `[k]` in units of the parameters, for use beside a curvature in nats."""
        return np.array([c.precision for c in self.coordinates]) * self.trust()

    def penalty(self, values: Array, stated: bool = False) -> float:
        """-2 log of the priors, up to a constant: of parameters that are stated (or of a kind), or of the others."""
        pairs = zip(self.coordinates, values, strict=True)
        out = float(sum(c.precision * (v - c.neutral) ** 2 for c, v in pairs if c.stated == stated and not c.kind))
        for kind, (far, n) in self._off(values).items() if stated else ():
            tail = (SURE + n) * float(np.log((SURE + max(far, n)) / (SURE + n)))  # its derivative is `trust`
            out += min(far, n) + tail if self.inferred is None else self.inferred[kind] * far
        return out

    def quadratic(self) -> tuple[Quadratic, Starts]:
        return eliminate(self.r, self.A, self.B, self.offsets, self.spread)


def broyden(A: Array, fit: Fit, values: Array, x: Array, r: Array, which: Sequence[int]) -> None:
    """Rank-one correction, in place, of the columns A not differenced anew, so that they explain the step just made."""
    dp = values - fit.values
    kept = [i for i in range(len(dp)) if i not in set(which)]
    if not kept or not np.any(dp[kept]):
        return
    missed = (fit.r - r) - fit.A @ dp - np.einsum("wns,ws->wn", fit.B, x - fit.offsets)
    scaled = dp[kept] / np.array([fit.coordinates[i].high - fit.coordinates[i].low for i in kept]) ** 2
    weight = scaled / max(float(scaled @ dp[kept]), 1e-300)
    share = float(scaled @ dp[kept]) / max(float(np.sum((dp / [c.high - c.low for c in fit.coordinates]) ** 2)), 1e-300)
    A[:, :, kept] += share * missed[:, :, None] * weight[None, None, :]


def settled(fit: Fit, tolerance: float) -> bool:
    """No step is promising, or those that were accepted gain little; refused ones are no sign of convergence."""
    if fit.promise < tolerance * abs(fit.cost) / 3 or fit.damping > 1e6:
        return True
    last = list(dict.fromkeys(fit.history))[-4:]  # accepted costs
    return len(last) == 4 and np.isfinite(last[0]) and last[0] - last[-1] < tolerance * abs(last[-1])
