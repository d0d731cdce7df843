"""What a person can do for an experiment, what else is worth recording, and why one is proposed; words: phrases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.experiment.design import Scored, Scorer
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
            out.append(Help(*phrases.known_payload(mass, place), shift))
        if effect.name == "gravity_tilt" and not _floats(physics.mj_model):
            for way, tilt in STANDING:
                shift = np.zeros(len(physics.space))
                shift[last.slice] = tilt
                out.append(Help(*phrases.other_mount(way), shift, tilt))
    return out


def _floats(model: mujoco.MjModel) -> bool:
    return bool(np.any(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)))


def title(model: Model) -> str:
    """Of a model, by its effects."""
    return phrases.model_title([(c.effect, c.where) for c in model.effects])


def witnesses(models: Sequence[Model], logs: Sequence[Log]) -> list[str]:
    """Streams that would decide between the models' effects and that the logs do not have."""
    have = {name.split(":", 1)[0] for log in logs for name in log.streams}
    wanted = dict(seen for m in models for c in m.effects if (seen := words(c.effect).witness) is not None)
    return [text for key, text in wanted.items() if key not in have]


def instead(models: Sequence[Model]) -> str:
    """What else would separate the models' effects."""
    return phrases.separating(c.effect for m in models for c in m.effects)


def reason(scorer: Scorer, chosen: Scored | None, labels: Sequence[str], contested: bool, useful: bool) -> str:
    """One sentence: the motion, the rivals, the expected evidence."""
    if chosen is None:
        return phrases.nothing_safe(instead(scorer.models))
    action = phrases.run_experiment(chosen.name, chosen.played.log.duration)
    if len(labels) == 1:
        index, variance = scorer.loosest(0)
        c, before = scorer.models[0].fit.coordinates[index], math.sqrt(variance)
        told = c.name, before, before * math.exp(-chosen.evidence), c.unit
        return phrases.sharpens(action, *told) if useful else phrases.sharpens_little(chosen.name, *told)
    if not useful:
        return phrases.separates_nobody(labels, chosen.name, chosen.evidence, instead(scorer.models))
    return phrases.tells_apart(action, labels, chosen.evidence, contested)
