"""The gap between a simulator and the logs: which share a better model closes, what it leaves, what counts as noise.

Whatever says one of these in numbers or words reads it here, so that no sentence contradicts the numbers beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Root mean square residual, in noise standard deviations, up to which a model is at the noise. It decides words, and
# whether the gap is located; verdicts rest on `selection.numbers.FLOOR` and on the force that is left. Counted:
# docs/decisions/at_noise.md
AT_NOISE = 1.15


@dataclass(frozen=True)
class Gap:
    """Squared residuals of one set of windows, under two models and under the noise alone; all in the same unit.

        closed = (E0 - max(E1, N)) / (E0 - N),  left = max(E1 - N, 0) / (E0 - N) = 1 - closed

    Attributes:
        before, after: E0 and E1, of the worse and of the better model, sums or means of squares.
        noise: N, what a perfect model leaves; 1 where residuals are in noise standard deviations.
    """

    before: float
    after: float
    noise: float = 1.0

    def share(self, part: float) -> float:
        """Return a part of E0 as a share of the squared gap above the noise, E0 - N; NaN where nothing is above it."""
        above = self.before - self.noise
        return part / above if above > 0.0 else math.nan

    @property
    def closed(self) -> float:
        """Share of the squared gap above the noise that is closed: at most 1, below 0 where it grows, NaN of none.

        Nothing undercuts the noise: the best of many models is below its own expected error by selection.
        """
        return self.share(self.before - max(self.after, self.noise))

    @property
    def left(self) -> float:
        """Share of the squared gap above the noise that is left, at least 0; NaN of none."""
        return self.share(max(self.after - self.noise, 0.0))

    @property
    def rms(self) -> float:
        """Root mean square residual of the better model, in noise standard deviations."""
        return math.sqrt(self.after / self.noise)

    @property
    def at_noise(self) -> bool:
        """Whether what the better model leaves counts as noise alone."""
        return self.rms <= AT_NOISE


def of_rms(before: float, after: float, noise: float = 1.0) -> Gap:
    """Return the gap between two root mean square residuals, by default in noise standard deviations."""
    return Gap(before**2, after**2, noise**2)


def of_one(squared: float, noise: float = 1.0) -> Gap:
    """Return the gap that one model leaves."""
    return Gap(squared, squared, noise)


def above_noise(rms: ArrayLike, noise: ArrayLike) -> NDArray[np.float64]:
    """Root mean square errors without the noise's part; all in one unit."""
    return np.asarray(np.sqrt(np.maximum(np.square(rms) - np.square(noise), 0.0)))
