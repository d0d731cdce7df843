"""The causes of a written case drawn again, to ask whether its logs tell each of them from every other one."""

from typing import Any

import numpy as np
from cases import KNOWN, SPREAD, SYSTEMS, draw_cause

from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.lookalikes import isolable, rivals
from bayessim_mjx.blind.reality.plant import Plant, base_parameters, scales_of
from bayessim_mjx.blind.reality.strength import Ruler

__all__ = ["KINDS", "each_isolable", "hidden", "looked_at", "seed_of"]

KINDS = ("single", "double", "null", "unknown")


def seed_of(kind: str, seed: int) -> int:
    """Each kind of case has base parameters and motions of its own."""
    return seed + 1_000_000 * KINDS.index(kind)


def hidden(truth: dict[str, Any]) -> tuple[list[Cause], Ruler]:
    """The causes of a written case and their ruler, drawn again.

    Raises:
        ValueError: the case was written by another version of the generator.
    """
    robot, seed = SYSTEMS[truth["system"]], seed_of(truth.get("kind", "single"), truth["seed"])
    rng = np.random.default_rng((seed, *truth["system"].encode()))
    base = base_parameters(robot, SPREAD, rng)
    rng.uniform()  # whether velocities are logged
    ruler = Ruler(robot, base, SPREAD, seed)
    causes: list[Cause] = []
    for told in truth["effects"]:
        cause = draw_cause(told["name"], robot, scales_of(ruler.plain, ruler.runs), causes, rng)
        cause.size = told.get("size", np.nan)
        Plant(robot, base, [cause])  # some parameters are known once the cause is in the model
        given = np.array([told["parameters"][k] for k in cause.parameters()])
        if cause.where != told["where"] or not np.allclose(list(cause.parameters().values()), given):
            raise ValueError(f"{truth['system']} {truth['seed']}: written by another version; generate it again")
        causes.append(cause)
    return causes, ruler


def looked_at(truth: dict[str, Any]) -> list[list[dict[str, Any]]]:
    """The rivals of every hidden cause, each as if it were there alone."""
    causes, ruler = hidden(truth)
    return [rivals(cause, ruler, KNOWN) for cause in causes]


def each_isolable(found: list[Any], truth: dict[str, Any]) -> bool:
    """Whether every hidden cause would be told from all others, were it there alone."""
    every = [found] if found and isinstance(found[0], dict) else found  # of a single as older versions wrote it
    return all(isolable(own, effect["left"]) for own, effect in zip(every, truth["effects"], strict=True))
