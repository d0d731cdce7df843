"""What the efforts contradict: one value for all joints where joints differ, and faults of drives that obey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error.channel import Channel
from bayessim_mjx.diagnosis.equation_error.fit import Fit, Term
from bayessim_mjx.diagnosis.equation_error.search import Found
from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.quantities import percent

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """When something is contradicted. Error rates: benchmarks/results.md (diagnosis: seconds first)."""

    tail: float = 1e-4  # of the chi-square distribution
    model: float = 0.03  # of the value itself: so much a law's form is worth
    inflated: float = 4.0  # variances: errors of the model are no independent noise
    left: float = 0.2  # of a joint's effort (rms): where more is not explained, nothing is contradicted


LIMITS = Limits()
TIED = ("actuator_gain", "coulomb_friction", "viscous_friction", "armature")
# what would make a drive's effort another function of its command than a scale and a constant
OF_DRIVES = ("actuator_deadband", "actuator_saturation", "rate_limit", "speed_torque_limit", "effort_loss")


def contradicted(
    model: mujoco.MjModel,
    sums: Sums,
    known: Sequence[Term],
    offered: Sequence[Term],
    found: Found,
    channels: Sequence[Channel],
) -> dict[str, str]:
    """{label of a candidate: why}."""
    out = {}
    for effect in TIED:
        each = [t for t in offered if t.effect == effect and t.where != "all"]
        if len(each) > 1 and (why := _differ(sums, known, found, each)):
            out[f"{effect}@all"] = why
    sound = {c.actuator: c for c in channels if c.static and c.sound}
    for effect in OF_DRIVES:
        for name, c in sound.items():
            out[f"{effect}@{name}"] = f"{name}'s effort follows its command but for {percent(c.left)}"
        if sound:
            out[f"{effect}@all"] = f"{next(iter(sound))}'s effort follows its command"
    return out


def _differ(sums: Sums, known: Sequence[Term], found: Found, each: Sequence[Term]) -> str:
    """Why one value for all places does not do: their values, or nothing.

    Each place has a value of its own, beside the other effects that were found; places whose effort is not explained
    then say nothing.
    """
    others = [p.term for p in found.proposals if p.term.effect != each[0].effect]
    own = fitting.fit(sums, [*known, *others, *each])
    size = fitting.size_of(sums)
    trusted = [t for t in each if _explains(t, own, size)]
    if len(trusted) < 2 or not np.isfinite(own.values).all():
        return ""
    values = np.array([own.of(t)[0] for t in trusted])
    index = [own.at(t).start for t in trusted]
    spread = own.inflated(LIMITS.inflated)[np.ix_(index, index)]
    spread = spread + np.diag((LIMITS.model * np.maximum(np.abs(values), np.abs(values).max() / 2)) ** 2)
    contrast = np.eye(len(values))[1:] - np.eye(len(values))[0]
    away = contrast @ values
    square = float(away @ np.linalg.solve(contrast @ spread @ contrast.T, away))
    if stats.chi2.sf(square, len(values) - 1) > LIMITS.tail:
        return ""
    shown = [next(iter(t.read(own.of(t)).values())) for t in trusted]
    low, high = int(np.argmin(shown)), int(np.argmax(shown))
    return f"{shown[low]:.2g} at {trusted[low].where}, {shown[high]:.2g} at {trusted[high].where}"


def _explains(term: Term, own: Fit, size: Array) -> bool:
    """Whether the efforts that a term acts on are explained."""
    acts = own.acts(term)
    return bool(acts.any() and np.all(np.sqrt(own.variance[acts]) < LIMITS.left * size[acts]))
