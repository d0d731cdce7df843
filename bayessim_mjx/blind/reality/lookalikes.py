"""Do these logs separate a hidden cause from every other one? From the truth alone, never from the library.

Every other cause of the generator is put in the place of the hidden one, sized as well as it can be, with the base
parameters within their spread and the start states free; what is left of the gap, without noise, is how far the two are
apart. All of them are sized by linearising the base parameters; the closest are then refitted, simulated at every step,
as what a gap of many noises leaves after a linear refit is mostly the linearisation's own error. Draws of shapes are
few, so that a rival may be better than found: then a case counts that should not.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from bayessim_mjx.blind.reality.cause import Cause, Scales
from bayessim_mjx.blind.reality.menu import CAUSES, KNOWN, places
from bayessim_mjx.blind.reality.plant import Plant, Run
from bayessim_mjx.blind.reality.strength import Ruler, largest_rms

# The first two say what counts as one motion. All 37 effects without a rival below them were named at their place (of
# 327 fresh cases, 69064f6). The others are what the time allows.
APART = 1.0  # encoder noises (rms over time, largest over joints): below, a rival explains the same motion
SHARE = 0.2  # and of what the known parameters leave: less is lost in the simulator's own step and in linearising
DRAWS = 2  # of a rival's sign and shape
STEPS = 3  # secant steps to its size
REFITS = 6  # Gauss-Newton steps of the closest, with the tangents of the motion without causes
TOLD = 5  # rivals kept
# what the laws can be besides what the generator draws: to a single joint a sine of its angle, or a force straight up,
# is what gravity does
SHAPES: dict[str, tuple[dict[str, Any], ...]] = {
    "cogging": ({"count": 1, "phase": 0.0}, {"count": 1, "phase": np.pi / 2}),
    "inertial_parameters": tuple({"direction": e, "swell": 0.0} for e in np.eye(3)),
    "external_force": ({"direction": np.eye(3)[0], "gusts": 0.0}, {"direction": np.eye(3)[2], "gusts": 0.0}),
}
_FIRST = 0.1  # of the largest size
_SIGNED = ("sign", "heading", "direction", "phase")  # what has one of these may act either way round


def isolable(found: list[dict[str, Any]], left: float) -> bool:
    """Whether every rival leaves enough; `left`: noises that base parameters alone leave (of the truth)."""
    return all(r["left"] >= max(APART, SHARE * left) for r in found)


def rivals(cause: Cause, ruler: Ruler, names: Sequence[str] = tuple(KNOWN)) -> list[dict[str, Any]]:
    """[{"name", "where", "left"}] among causes of these names, the closest first: left in encoder noises."""
    scales = cause.scales
    runs = record(cause, ruler)
    gap = ruler.windows(ruler.plain, runs)
    near = _joint(cause, ruler, gap)
    every = [(*_best(*other, scales, ruler, runs, gap), *other) for other in _others(cause, ruler, names, near)]
    found: list[dict[str, Any]] = []
    for left, rival, name, where in sorted(every, key=lambda r: r[0])[:TOLD]:
        found.append({"name": name, "where": where, "left": min(left, _refitted(rival, ruler, runs, gap))})
    return sorted(found, key=lambda r: r["left"])


def apart(cause: Cause, name: str, where: str, ruler: Ruler) -> float:
    """Measure what the best cause of that name and place leaves of another one's motion, in encoder noises."""
    runs = record(cause, ruler)
    gap = ruler.windows(ruler.plain, runs)
    left, rival = _best(name, where, cause.scales, ruler, runs, gap)
    return min(left, _refitted(rival, ruler, runs, gap))


def _best(name: str, where: str, scales: Scales, ruler: Ruler, runs: list[Run], gap: np.ndarray) -> tuple[float, Cause]:
    """Find the closest draw: (noises that it leaves, the draw)."""
    rng = np.random.default_rng((ruler.seed, *name.encode()))
    each = [(_closest(rival, ruler, runs, gap), rival) for rival in _drawn(name, where, scales, rng)]
    return min(each, key=lambda r: r[0])


def record(cause: Cause, ruler: Ruler) -> list[Run]:
    """Record the runs that measure strength, with a cause and without noise."""
    plant = Plant(ruler.system, ruler.base, [cause])
    return [ruler.system.record(plant, i, ruler.seed, noise=False) for i in ruler.system.pushed]


def _joint(cause: Cause, ruler: Ruler, gap: np.ndarray) -> str:
    """Find the cause's joint; of a cause at a body or the world the joint that shows most of it."""
    if cause.kind in ("joint", "actuator"):
        return cause.scales.drives.get(cause.where, cause.where)
    return ruler.plain.joints[int(np.argmax(np.mean(gap**2, axis=(0, 1))))]


def _others(cause: Cause, ruler: Ruler, names: Sequence[str], near: str) -> list[tuple[str, str]]:
    """List other causes at this joint, its actuator, bodies, the world and contacts, and the same law elsewhere."""
    out, scales = [], cause.scales
    for name in names:
        for where in places(ruler.system, name, scales):
            here = CAUSES[name].kind not in ("joint", "actuator") or scales.drives.get(where, where) == near
            if where != cause.where if name == cause.name else here:
                out.append((name, where))
    return out


def _drawn(name: str, where: str, scales: Scales, rng: np.random.Generator) -> list[Cause]:
    """Draw a cause with some signs and shapes."""
    out = [CAUSES[name](where, scales, rng) for _ in range(DRAWS)]
    for shape in SHAPES.get(name, ()):
        out.append(CAUSES[name](where, scales, rng))
        vars(out[-1]).update(shape)
    return out


def _closest(rival: Cause, ruler: Ruler, runs: list[Run], gap: np.ndarray) -> float:
    """Compute what the best size of a rival leaves, in noises."""
    either = any(hasattr(rival, a) for a in _SIGNED)
    smallest = max(rival.smallest, 1e-4 * rival.largest)
    rival.size, best = max(_FIRST * rival.largest, smallest), np.inf
    for _ in range(STEPS):
        other = ruler.windows(Plant(ruler.system, ruler.base, [rival]), runs)
        if not np.isfinite(other).all():
            rival.size = max(0.3 * rival.size, smallest)
            continue
        scale, left = _scaled(ruler, gap, other, either)
        best = min(best, left)
        if best < APART / 2 or abs(scale - 1) < 0.1:
            break
        if scale < 0:
            vars(rival)["sign"] = -getattr(rival, "sign", 1.0)
        rival.size = float(np.clip(abs(scale) * rival.size, smallest, rival.largest))
    return best


def _scaled(ruler: Ruler, gap: np.ndarray, other: np.ndarray, either: bool) -> tuple[float, float]:
    """(best multiple of the rival's change, what is left): base parameters and start states as they like."""
    target, column = ruler.outside(gap)[:, 0], ruler.outside(other - gap)[:, 0]
    size = max(float(np.abs(column).max()), 1e-12)
    A = np.column_stack([ruler.outside(ruler.tangents), column / size])
    most = 1.5 * size
    low, high = np.append(ruler.bounds[0], -most if either else 0.0), np.append(ruler.bounds[1], most)
    fit = lsq_linear(A, -target, bounds=(low, high))
    left = (target + A @ fit.x).reshape(gap.shape)
    return float(fit.x[-1] / size), largest_rms(left)


def _refitted(rival: Cause, ruler: Ruler, runs: list[Run], gap: np.ndarray) -> float:
    """Compute what a rival leaves, in noises, once its size and the base parameters are refitted by simulation."""
    names, shift, best = list(ruler.base), np.zeros(len(ruler.base)), np.inf
    tangents, (low, high) = ruler.outside(ruler.tangents), ruler.bounds
    smallest = max(rival.smallest, 1e-4 * rival.largest)
    for _ in range(REFITS):
        base = {name: ruler.base[name] + float(own) for name, own in zip(names, shift, strict=True)}
        now, without = (ruler.windows(Plant(ruler.system, base, causes), runs) for causes in ([rival], []))
        if not (np.isfinite(now).all() and np.isfinite(without).all()):
            break
        target, column = ruler.outside(now)[:, 0], ruler.outside(now - without)[:, 0]
        left = largest_rms(target.reshape(gap.shape))
        if left > 0.99 * best or left < APART / 2:
            return min(best, left)
        best = left
        size = max(float(np.abs(column).max()), 1e-12)
        room = size * (np.array([smallest, rival.largest]) / rival.size - 1)
        ends = np.append(low - shift, room[0]), np.append(high - shift, room[1])
        ends = np.minimum(ends[0], -1e-9), np.maximum(ends[1], 1e-9)
        step = lsq_linear(np.column_stack([tangents, column / size]), -target, bounds=ends).x
        shift = np.clip(shift + step[:-1], low, high)
        rival.size = float(np.clip(rival.size * (1 + step[-1] / size), smallest, rival.largest))
    return best
