"""Words about experiments: what separates an effect from its look-alikes, what else to record, why one is proposed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.effects.support.words import words
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]

PAYLOAD_SHARE = 0.5  # of the largest payload that is thought possible at the body
STANDING = (("turned on its side (90 degrees about the world's x axis)", (math.pi / 2, 0.0)),
            ("turned forward (90 degrees about the world's y axis)", (0.0, math.pi / 2)))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Help:
    """What a person changes: name, instruction, what it adds to theta `[P]`, and the mount's (roll, pitch)."""

    name: str
    needs: str
    shift: Array
    tilt: tuple[float, float] = (0.0, 0.0)


def helps(setup: Setup) -> list[Help]:
    """A known payload on the last body, and two other mounts: where the effects that describe them are in the stack."""
    physics, out = setup.physics, []
    for effect in physics.effects:
        *_, last = physics.blocks_of(effect)
        if effect.name == "payload":
            place, own = last.place, last.parameters[0]
            mass = float(f"{PAYLOAD_SHARE * own.high:.2g}")
            shift = np.zeros(len(physics.space))
            shift[last.start] = mass
            needs = f"a person: fix a known mass of {mass:g} kg at the centre of {place}"
            out.append(Help(f"with a known payload of {mass:g} kg on {place}", needs, shift))
        if effect.name == "gravity_tilt" and not _floats(physics.mj_model):
            for name, tilt in STANDING:
                shift = np.zeros(len(physics.space))
                shift[last.slice] = tilt
                out.append(Help(f"base {name}", f"a person: mount the base {name}", shift, tilt))
    return out


def _floats(model: mujoco.MjModel) -> bool:
    return bool(np.any(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)))


def title(model: Model) -> str:
    """'load friction at elbow and actuator delay at elbow_motor'."""
    if not model.effects:
        return "the known parameters alone"
    places = ["everywhere" if c.where == "all" else f"at {c.where}" for c in model.effects]
    return " and ".join(f"{c.effect.replace('_', ' ')} {p}" for c, p in zip(model.effects, places, strict=True))


def witnesses(models: Sequence[Model], logs: Sequence[Log]) -> list[str]:
    """Streams that would decide between the models' effects and that the logs do not have."""
    have = {name.split(":", 1)[0] for log in logs for name in log.streams}
    wanted = dict(seen for m in models for c in m.effects if (seen := words(c.effect).witness) is not None)
    return [text for key, text in wanted.items() if key not in have]


def instead(models: Sequence[Model]) -> str:
    """What else would separate the models' effects, in the effects' own words."""
    effects = dict.fromkeys(c.effect for m in models for c in m.effects)
    known = [f"{e.replace('_', ' ')}: {how}" for e in effects if (how := words(e).separates)]
    return "; ".join(known) or "a known payload, two mount orientations, or a measured effort"


def reason(scorer: Any, chosen: Any, labels: Sequence[str], contested: bool, useful: bool, limits: Any) -> str:
    """One sentence: the motion, the rivals, the expected evidence."""
    rivals = f"{labels[0]} from {', '.join(labels[1:-1]) + ' and ' if len(labels) > 2 else ''}{labels[-1]}"
    if chosen is None:
        return f"no experiment of the menu stays within the limits; what would help: {instead(scorer.models)}"
    action = f"run {_article(chosen.name)}{chosen.name} for {chosen.played.log.duration:.0f} s"
    if len(labels) == 1:
        return _sharpening(scorer, chosen, action)
    if not useful:
        most = f"the best, {chosen.name}, is expected to give {nats(chosen.evidence)} nats"
        return f"no safe excitation separates {rivals} ({most}); what would: {instead(scorer.models)}"
    verb = "separates" if contested else "makes sure of"
    weak = 10.0 / max(chosen.evidence, 1e-9)
    again = f"; repeat it {math.ceil(weak)} times for a decision" if 1.3 < weak <= 10 else ""
    rivals = rivals if contested else rivals.replace(" from ", " against ", 1)
    return f"{action}: {verb} {rivals}, expected evidence {nats(chosen.evidence)} nats{again}"


def nats(evidence: float) -> str:
    return f"{evidence:.0f}" if evidence >= 10 else f"{evidence:.1f}"


def _article(name: str) -> str:
    return "a " if name.startswith(("slow triangle", "staircase", "chirp", "multisine")) else ""


def _sharpening(scorer: Any, chosen: Any, action: str) -> str:
    index, variance = scorer.loosest(0)
    c = scorer.models[0].fit.coordinates[index]
    before = math.sqrt(variance)
    after = before * math.exp(-chosen.evidence)
    return f"{action}: sharpens {c.name}, standard deviation from {before:.2g} to {after:.2g} {c.unit}".rstrip()
