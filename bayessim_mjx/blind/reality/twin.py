"""Causes with the parameters that a diagnosis names: how much its correction closes in the finer reality."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Scales
from bayessim_mjx.blind.reality.menu import KNOWN, places
from bayessim_mjx.blind.reality.plant import Plant, Rig
from bayessim_mjx.blind.reality.strength import Ruler

Parameters = Mapping[str, float]


def _size(name: str, scale: float = 1.0) -> Callable[[Any, Parameters], None]:
    def put(cause: Any, p: Parameters) -> None:
        cause.size = max(scale * p[name], 0.0)

    return put


def _signed(name: str, neutral: float = 0.0) -> Callable[[Any, Parameters], None]:
    def put(cause: Any, p: Parameters) -> None:
        cause.size, cause.sign = abs(p[name] - neutral), math.copysign(1.0, p[name] - neutral)

    return put


def _stribeck(cause: Any, p: Parameters) -> None:
    cause.size, cause.speed = max(p["level"], 1e-12), max(p["speed"], 1e-9)
    cause.ratio = 1 + p["excess"] / cause.size


def _lugre(cause: Any, p: Parameters) -> None:
    _stribeck(cause, p)
    cause.stiffness = cause.highest() / max(p["bend"], 1e-9)


def _asymmetric(cause: Any, p: Parameters) -> None:
    ahead, back = max(p["level_forward"], 0.0), max(p["level_backward"], 0.0)
    cause.size, cause.side = max(ahead, back), 1.0 if ahead >= back else -1.0
    cause.part = min(ahead, back) / max(cause.size, 1e-12)


def _spring(cause: Any, p: Parameters) -> None:
    low, high = cause.scales.travel[cause.where]
    linear, cubic = p.get("stiffness", 0.0), p.get("cubic", 0.0)
    cause.order = 2 if abs(cubic) * (high - low) ** 2 > abs(linear) else 0
    cause.size, cause.rest = cubic if cause.order else linear, p["rest"]


def _cable(cause: Any, p: Parameters) -> None:
    ahead, back = max(p["forward"], 0.0), max(p["backward"], 0.0)
    cause.size, cause.side, cause.taut = max(ahead, back), 1.0 if ahead >= back else -1.0, p["taut"]
    cause.other = min(ahead, back) / max(cause.size, 1e-12)


def _profile(cause: Any, p: Parameters) -> None:
    most = cause.scales.command[cause.where]
    cause.size = max(p["inertness"] * most, cause.smallest)
    cause.slow = max(p["slowness"], 0.0) * most / math.sqrt(cause.size)


def _inertial(cause: Any, p: Parameters) -> None:
    shift = np.array([p[f"com_{a}"] for a in "xyz"])
    cause.size = max(float(np.linalg.norm(shift)), 1e-9)
    cause.direction, cause.sign = shift / cause.size, 1.0
    cause.swell = (p["inertia"] - 1) * cause.largest / cause.size


def _saturation(cause: Any, p: Parameters) -> None:
    cause.size = max(cause.scales.effort[cause.where] * p["inverse_limit"] - 1, 0.0)


def _speed_torque(cause: Any, p: Parameters) -> None:
    cause.stall = 1 / max(p["inverse_stall"], 1e-12)
    cause.size = cause.scales.speed[cause.joint] * p["inverse_speed"]


def _cogging(cause: Any, p: Parameters) -> None:
    cause.size, cause.phase = math.hypot(p["sine"], p["cosine"]), math.atan2(p["cosine"], p["sine"])
    cause.count = p["order"]


def _coupling(cause: Any, p: Parameters) -> None:
    ahead = abs(p["to_next"]) >= abs(p["to_previous"])
    share = p["to_next"] if ahead else p["to_previous"]
    cause.size, cause.sign = abs(share), math.copysign(1.0, share)
    cause.other = cause.scales.chain[cause.joint][1 if ahead else 0] or cause.other


def _tilt(cause: Any, p: Parameters) -> None:
    along, aside = math.sin(p["pitch"]), -math.sin(p["roll"]) * math.cos(p["pitch"])
    cause.size, cause.heading = math.asin(min(math.hypot(along, aside), 1.0)), math.atan2(aside, along)


WRITTEN: dict[str, Callable[[Any, Parameters], None]] = {
    "coulomb_friction": _size("level"), "stribeck_friction": _stribeck, "asymmetric_friction": _asymmetric,
    "viscous_friction": _size("damping"), "quadratic_drag": _size("coefficient"), "armature": _size("inertia"),
    "joint_spring": _spring, "backlash": _size("gap", 2.0), "joint_elasticity": _size("compliance"),
    "actuator_delay": _size("delay"), "actuator_lag": _size("time_constant"), "actuator_gain": _signed("gain", 1.0),
    "servo_stiffness": _signed("factor", 1.0), "servo_damping": _signed("factor", 1.0),
    "actuator_bias": _signed("bias"), "actuator_deadband": _size("half_width"), "actuator_saturation": _saturation,
    "speed_torque_limit": _speed_torque, "cogging": _cogging, "gravity_tilt": _tilt,
    "joint_offset": _signed("offset"), "sensor_delay": _size("delay"), "sensor_filter": _size("time_constant"),
    "sensor_gain": _signed("gain", 1.0), "lugre_friction": _lugre, "cable_tension": _cable,
    "gain_drift": _signed("drift"), "effort_coupling": _coupling, "acceleration_limit": _profile,
    "inertial_parameters": _inertial,
    "gravity_compensation": _signed("share"), "ground_height": _signed("height"),
    "effort_loss": lambda c, p: setattr(c, "size", max(p["loss"] * c.scales.effort[c.where], 0.0)),
    "rate_limit": lambda c, p: setattr(c, "size", max(p["slowness"] * c.scales.rate[c.where], 0.0)),
}  # fmt: skip


def twins(rig: Rig, scales: Scales, named: Sequence[Mapping[str, Any]]) -> list[Cause] | None:
    """Causes for the effects of a diagnosis.json; None where one of them does not mean the same here."""
    out = []
    for effect in named:
        if effect["name"] not in WRITTEN:
            return None
        joints = [scales.drives.get(w, w) for w in str(effect["where"]).replace("+", ",").split(",")]
        spots = [
            w for w in places(rig, effect["name"], scales)
            if effect["where"] in ("all", w) or scales.drives.get(w, w) in joints
        ]  # fmt: skip
        if not spots:
            return None
        values = {k: float(v["mean"]) for k, v in effect["parameters"].items()}
        for where in spots:
            cause = KNOWN[effect["name"]](where, scales, np.random.default_rng(0))
            try:
                WRITTEN[effect["name"]](cause, values)
            except KeyError:
                return None
            out.append(cause)
    return out


def closed(ruler: Ruler, truth: Plant, corrected: Plant) -> float | None:
    """Share of the squared gap, above what a refit of the data-sheet values leaves of it, that a correction closes.

    Noise-free motion of the truth; start states are free. Negative where the correction makes it worse; None where
    there is no gap.
    """
    rig = ruler.system
    runs = [rig.record(truth, i, ruler.seed, noise=False) for i in rig.pushed]
    _, before = ruler.measure(runs)
    gap = ruler.windows(corrected, runs)
    if not (np.isfinite(before) and np.isfinite(gap).all() and before > 0):
        return None
    left = ruler.outside(gap)[:, 0].reshape(gap.shape)
    return float(1 - np.mean(left**2, axis=(0, 1)).max() / before**2)


def base_of(parameters: Mapping[str, Mapping[str, float]], names: Sequence[str]) -> dict[str, float]:
    """Factors of the known parameters in a diagnosis.json, 1 where it has none; {} where it has no factors."""
    given = {n: parameters.get(n.rpartition(".")[0] + "_" + n.rpartition(".")[2] + "_mult") for n in names}
    if not any(given.values()):
        return {}
    return {n: float(v["mean"]) / float(v.get("nominal", 1.0) or 1.0) if v else 1.0 for n, v in given.items()}
