"""Which inertial parameters the motion shows at all: base parameters of the regressor, and masses that stay unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.equation_error.fit import Fit, Term, used
from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.diagnosis.logcheck import rigid_body


@dataclass(frozen=True)
class Limits:
    """What counts as shown."""

    rank: float = 1e-7  # of the largest singular value squared, columns at unit length
    shown: float = 0.7  # of what the data sheet leaves open: a mass whose deviation stays above this is not told


LIMITS = Limits()


@dataclass(frozen=True)
class Told:
    """What the motion shows of the inertial parameters.

    Attributes:
        parameters: of all moving bodies; combinations: of them that act on the known efforts in these logs (base
            parameters, Gautier 1991, by eigenvalues of the regressor's products).
        unknown: bodies whose mass these logs do not tell better than the data sheet.
    """

    parameters: int
    combinations: int
    unknown: tuple[str, ...]


def told_by(model: mujoco.MjModel, sums: Sums, known: Sequence[Term], found: Fit) -> Told:
    """From the products of the columns, and from the fit's covariance."""
    count = rigid_body.INERTIAL * sums.layout.bodies
    weight = np.where(used(sums), 1.0 / found.variance, 0.0)
    S = np.einsum("v,vpq->pq", weight, sums.whole[:, :count, :count])
    size = np.sqrt(np.diag(S))
    seen = size > 1e-6 * size.max(initial=1e-300)
    scaled = S[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    values = np.linalg.eigvalsh(scaled) if seen.any() else np.zeros(0)
    rank = int(np.sum(values > LIMITS.rank * values.max(initial=1e-300)))
    masses = [t for t in known if t.effect == "mass"]
    nothing = np.full(1, np.nan)
    unknown = [t.where for t in masses if found.deviation(t)[0] > LIMITS.shown * t.sd(nothing)[0]]
    return Told(count, rank, tuple(unknown))
