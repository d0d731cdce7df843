"""Where physics ends, whatever the range of a parameter is."""

import math
from typing import Any

from bayessim_mjx.parameters.parameter import Parameter
from bayessim_mjx.parameters.reading import own_value

SIGNED = ("bias", "com_x", "com_y", "com_z", "gravity")  # numbers of the model that may be negative


def ends(p: Parameter, model: Any = None) -> tuple[float, float]:
    """(lowest, highest) theta at which a parameter of the model has a meaning; infinite where nothing limits it.

    Masses, sizes, friction, damping, stiffness and gains are not negative; a restitution is a share.

    Args:
        p: of kind "effect": nothing is known here, see `effects.Quantity.ends`.
        model: the nominal `mujoco.MjModel`, to which an additive parameter is added; None: its own range is the limit.
    """
    if p.kind == "effect":
        return -math.inf, math.inf
    if p.attribute in SIGNED:
        return -math.inf, math.inf
    if p.factor < 0:
        return p.low, p.high
    highest = 1 / p.factor if p.attribute == "restitution" else math.inf
    if p.operation != "additive":
        return 0.0, highest
    if model is None:
        return p.low, p.high
    return -own_value(model, p.kind, p.attribute, p.target) / p.factor, highest
