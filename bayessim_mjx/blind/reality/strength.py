"""How strong a cause is, in encoder noises: before and after what a refit of the base parameters can hide."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear

from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.plant import Plant, Rig, Run

# WINDOW and HIDDEN define the unit of strength (docs/blind.md): detection curves are in it, whatever they are.
WINDOW = 0.5  # s, over which a cause is compared with the noise
HIDDEN = 3.0  # a cause counts as no more than this many times what a refit leaves of it
TRIALS = 14  # of a size, until its strength is within 10 % of the goal
MOST = 64  # windows, about
_NUDGE = 0.02  # of a base parameter, for its tangent


class Ruler:
    """Measures how far runs with causes are from what the same robot without them would do.

    raw: from measured states, under the logged commands, within windows; root mean square over time, in encoder noises,
    largest over joints. left: the same after the best (linear) change of base parameters within their +-spread around
    nominal and of each window's initial state. The tangents are those of the motion without causes.
    """

    def __init__(self, system: Rig, base: dict[str, float], spread: float, seed: int) -> None:
        self.system, self.seed, self.base = system, seed, base
        self.plain = Plant(system, base)
        self.runs = [system.record(self.plain, i, seed, noise=False) for i in system.pushed]
        self.rows = round(WINDOW / system.period)
        at_rest = self.windows(self.plain, self.runs)
        tangents = []
        for name in base:
            other = Plant(system, base | {name: base[name] + _NUDGE})
            tangents.append((self.windows(other, self.runs) - at_rest) / _NUDGE)
        sizes = [len(x) for x in self.plain.link()]
        starts = []
        for i in range(sum(sizes)):
            shift = np.zeros(sum(sizes))
            shift[i] = 1e-4
            moved = self.windows(self.plain, self.runs, np.split(shift, sizes[:1]))
            starts.append((moved - at_rest) / 1e-4)
        self.tangents = np.stack(tangents, -1)
        # orthonormal basis of what initial states can do, by window
        self.free = np.linalg.qr(np.stack(starts, -1).reshape(len(at_rest), -1, len(starts)))[0]
        scale = np.array(list(base.values()))
        self.bounds = (np.minimum(1 - spread - scale, -1e-9), np.maximum(1 + spread - scale, 1e-9))

    def windows(self, plant: Plant, runs: Sequence[Run], shift: Sequence[np.ndarray] | None = None) -> np.ndarray:
        """Subtract recorded from simulated positions, `[windows, rows, n]`, in noises."""
        dq, dv = shift or (0.0, 0.0)
        out = []
        starts = [(r, start) for r in runs for start in range(0, len(r.time) - self.rows, self.rows)]
        thin = max(1, len(starts) // MOST)
        for r, start in starts[::thin]:
            plant.reset(r.clean[start] + dq, r.clean_v[start] + dv, r.ctrl[start])
            plant.resume(r, start)
            for k in range(start, start + self.rows):
                self.system.repeat(plant, r, k)
                out.append(plant.measure()[0] - r.clean[k + 1])
        return np.array(out).reshape(-1, self.rows, len(self.system.sigma)) / np.asarray(self.system.sigma)

    def outside(self, x: np.ndarray) -> np.ndarray:
        """Columns `[windows, rows, joints, ...]` without the part that initial states explain, flattened."""
        flat, free = x.reshape(*x.shape[:1], self.rows * x.shape[2], -1), self.free
        return (flat - free @ (np.swapaxes(free, 1, 2) @ flat)).reshape(-1, flat.shape[-1])

    def measure(self, runs: Sequence[Run]) -> tuple[float, float]:
        """(raw, left) of runs with causes."""
        gap = self.windows(self.plain, runs)
        raw = largest_rms(gap)
        if not np.isfinite(raw):
            return np.inf, np.inf
        tangents, target = self.outside(self.tangents), self.outside(gap)[:, 0]
        fit = lsq_linear(tangents, -target, bounds=self.bounds)
        return raw, largest_rms((target + tangents @ fit.x).reshape(gap.shape))


def largest_rms(gap: np.ndarray) -> float:
    return float(np.sqrt(np.mean(gap**2, axis=(0, 1))).max())


def resize(cause: Cause, ruler: Ruler, goal: float) -> tuple[float, float]:
    """Set `cause.size` so that min(raw, HIDDEN left) is `goal`; (raw, left) reached: less where the range ends."""

    def reached(size: float) -> tuple[float, float]:
        cause.size = float(size)
        plant = Plant(ruler.system, ruler.base, [cause])
        return ruler.measure([ruler.system.record(plant, i, ruler.seed, noise=False) for i in ruler.system.pushed])

    low, high = max(cause.smallest, 1e-4 * cause.largest), cause.largest
    size = np.sqrt(low * high)
    for _ in range(TRIALS):
        result = reached(size)
        value = min(result[0], HIDDEN * result[1])
        if 0.9 * goal < value < 1.1 * goal or high / low < 1.02:
            break
        low, high = (size, high) if value < goal else (low, size)
        # causes grow about in proportion: guess so, and stay inside the bracket
        guess = size * goal / value if np.isfinite(value) and value > 0 else np.sqrt(low * high)
        size = guess if low * 1.05 < guess < high / 1.05 else np.sqrt(low * high)
    return result
