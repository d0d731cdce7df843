"""The cause of a written case drawn again, to ask whether its logs tell it from every other one."""

from typing import Any

import numpy as np
from cases import SPREAD, SYSTEMS, draw_cause

from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.lookalikes import isolable, rivals
from bayessim_mjx.blind.reality.plant import Plant, base_parameters, scales_of
from bayessim_mjx.blind.reality.strength import Ruler

__all__ = ["hidden", "isolable", "rivals"]


def hidden(truth: dict[str, Any]) -> tuple[Cause, Ruler]:
    """The cause of a written case and its ruler, drawn again.

    Raises:
        ValueError: the case was written by another version of the generator.
    """
    robot, told = SYSTEMS[truth["system"]], truth["effects"][0]
    rng = np.random.default_rng((truth["seed"], *truth["system"].encode()))
    base = base_parameters(robot, SPREAD, rng)
    rng.uniform()  # whether velocities are logged
    ruler = Ruler(robot, base, SPREAD, truth["seed"])
    cause = draw_cause(told["name"], robot, scales_of(ruler.plain, ruler.runs), [], rng)
    cause.size = told.get("size", np.nan)
    Plant(robot, base, [cause])  # some parameters are known once the cause is in the model
    given = np.array([told["parameters"][k] for k in cause.parameters()])
    if cause.where != told["where"] or not np.allclose(list(cause.parameters().values()), given):
        raise ValueError(f"{truth['system']} {truth['seed']}: written by another version; generate it again")
    return cause, ruler
