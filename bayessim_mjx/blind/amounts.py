"""Strengths of effects as people state them: one number with its unit for each cause, larger where the effect is."""

import dataclasses
import math
from collections.abc import Callable, Mapping

from bayessim_mjx.quantities import extent, number, percent

Parameters = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Amount:
    """One number of a cause.

    Attributes:
        what: the number, in words: "half of the play".
        unit: with F for N m or N, q for rad or m, I for inertia; "1" for shares.
        of: makes it of the cause's parameters; it grows with the effect.
        inverse: people state one over it (a limit).
    """

    what: str
    unit: str
    of: Callable[[Parameters], float]
    inverse: bool = False


def _take(name: str) -> Callable[[Parameters], float]:
    return lambda p: abs(p[name])


def _either(*names: str) -> Callable[[Parameters], float]:
    return lambda p: max(abs(p[n]) for n in names if n in p)


def _root(*names: str) -> Callable[[Parameters], float]:
    return lambda p: math.hypot(*(p[n] for n in names))


AMOUNTS: dict[str, Amount] = {
    "coulomb_friction": Amount("level", "F", _take("level")),
    "stribeck_friction": Amount("level", "F", _take("level")),
    "lugre_friction": Amount("level", "F", _take("level")),
    "load_friction": Amount("share of the load", "1", _take("motor")),
    "asymmetric_friction": Amount("larger level", "F", _either("level_forward", "level_backward")),
    "viscous_friction": Amount("damping", "F s/q", _take("damping")),
    "quadratic_drag": Amount("coefficient", "F s²/q²", _take("coefficient")),
    "body_drag": Amount("linear coefficient", "N s/m", _take("linear")),
    "directional_drag": Amount("linear coefficient", "N s/m", _take("linear")),
    "wind": Amount("linear coefficient", "N s/m", _take("linear")),
    "armature": Amount("inertia", "I", _take("inertia")),
    "joint_spring": Amount("stiffness", "F/q", _either("stiffness", "cubic")),
    "cable_tension": Amount("stiffness", "F/q", _either("forward", "backward")),
    "backlash": Amount("half of the play", "q", _take("gap")),
    "joint_elasticity": Amount("compliance", "q/F", _take("compliance")),
    "actuator_delay": Amount("delay", "s", _take("delay")),
    "actuator_lag": Amount("time constant", "s", _take("time_constant")),
    "actuator_gain": Amount("error", "1", lambda p: abs(p["gain"] - 1)),
    "gain_drift": Amount("change in a minute", "1", _take("drift")),
    "effort_coupling": Amount("share of the effort", "1", _either("to_next", "to_previous")),
    "servo_stiffness": Amount("error", "1", lambda p: abs(p["factor"] - 1)),
    "servo_damping": Amount("error", "1", lambda p: abs(p["factor"] - 1)),
    "actuator_bias": Amount("bias", "F", _take("bias")),
    "actuator_deadband": Amount("half width", "command", _take("half_width")),
    "actuator_saturation": Amount("limit", "F", _take("inverse_limit"), inverse=True),
    "speed_torque_limit": Amount("free speed", "q/s", _take("inverse_speed"), inverse=True),
    "effort_loss": Amount("loss", "1/F", _take("loss")),
    "cogging": Amount("amplitude", "F", _root("sine", "cosine")),
    "rate_limit": Amount("limit", "command/s", _take("slowness"), inverse=True),
    "acceleration_limit": Amount("limit", "command/s²", _take("inertness"), inverse=True),
    "payload": Amount("mass", "kg", _take("mass")),
    "inertial_parameters": Amount("shift of the centre of mass", "m", _root("com_x", "com_y", "com_z")),
    "gravity_compensation": Amount("share of the weight", "1", _take("share")),
    "gravity_tilt": Amount("tilt", "rad", _root("roll", "pitch")),
    "external_force": Amount("force", "N", _root("force_x", "force_y", "force_z")),
    "base_flexibility": Amount("compliance", "rad/(N m)", _take("compliance")),
    "contact_friction": Amount("change, logarithm", "1", lambda p: abs(math.log(p["scale"]))),
    "contact_compliance": Amount("softness", "", _take("softness")),
    "ground_height": Amount("height", "m", _take("height")),
    "joint_offset": Amount("offset", "q", _take("offset")),
    "sensor_delay": Amount("delay", "s", _take("delay")),
    "sensor_filter": Amount("time constant", "s", _take("time_constant")),
    "sensor_gain": Amount("error", "1", lambda p: abs(p["gain"] - 1)),
}
OTHER = Amount("size", "", _take("size"))


def amount_of(effect: str, parameters: Parameters) -> float:
    """Give the number of a cause with these parameters."""
    return float(AMOUNTS.get(effect, OTHER).of(parameters))


def unit_of(effect: str, slide: bool) -> str:
    """`N m s/rad`, or `N s/m` at a slide."""
    text = AMOUNTS.get(effect, OTHER).unit
    if text == "I":
        return "kg" if slide else "kg m²"
    force, way = ("N", "m") if slide else ("N m", "rad")
    compound = text not in ("F", "q")
    text = text.replace("q/F", f"{way}/({force})" if " " in force else f"{way}/{force}")
    text = text.replace("1/F", f"1/({force})" if " " in force and compound else f"1/{force}")
    return text.replace("F", force).replace("q", way)


def in_words(effect: str, value: float, slide: bool = False) -> str:
    """`0.17 deg`, `3.1 N m`, `12 %`, `4.0 ms`; of a limit, one over the value."""
    amount, unit = AMOUNTS.get(effect, OTHER), unit_of(effect, slide)
    if not math.isfinite(value) or (amount.inverse and value <= 0):
        return number(math.nan)
    shown = 1 / value if amount.inverse else value
    if unit in ("rad", "m"):
        return extent(shown, unit)
    if unit == "s":
        return f"{number(1e3 * shown, 2)} ms"
    if unit == "1":
        return percent(shown)
    return f"{number(shown, 2)} {unit}".replace(" command", "").strip()


def spoken(effect: str) -> str:
    """`coulomb friction`."""
    return effect.removeprefix("unknown_").replace("_", " ")
