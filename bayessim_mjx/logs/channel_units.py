"""Units of a model's channels, for the axes of pictures."""

from __future__ import annotations

import mujoco

from bayessim_mjx.logs.log import Channels

RATES = {"rad": "rad/s", "m": "m/s"}
EFFORTS = {"rad": "N m", "m": "N"}


def units_of(model: mujoco.MjModel) -> dict[str, str]:
    """{`qpos:elbow`: "rad"} of positions, velocities and commands. Efforts are logged in any unit, and have none."""
    names, found = Channels.of(model), dict[str, str]()
    for joint, kind in zip(names.joints, names.kinds, strict=True):
        own = {"slide": ["m"], "hinge": ["rad"], "ball": ["rad"] * 3}.get(kind, ["m"] * 3 + ["rad"] * 3)
        places = own if kind in ("slide", "hinge") else own[: -3 if kind == "free" else 0]  # no quaternions
        found |= {f"qpos:{n}": u for n, u in zip(names.of_joint(joint), places, strict=False)}
        found |= {f"qvel:{n}": RATES[u] for n, u in zip(names.of_joint(joint, "qvel"), own, strict=True)}
    for i, name in enumerate(names.actuators):
        if int(model.actuator_trntype[i]) > int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            continue
        joint = names.joints[int(model.actuator_trnid[i, 0])]
        length = found.get(f"qpos:{joint}")
        if length is None:
            continue
        found[f"ctrl:{name}"] = _command(model, i, length)
    return {channel: unit for channel, unit in found.items() if unit}


def _command(model: mujoco.MjModel, i: int, length: str) -> str:
    """Name the unit of an actuator's command; "" of a motor whose command is a share of its effort, or unknown."""
    gain, bias = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i]
    if float(model.actuator_gear[i, 0]) != 1.0:
        return ""
    if bias[1] != 0:  # a servo
        return length if gain == -bias[1] else ""
    if bias[2] != 0:
        return RATES[length] if gain == -bias[2] else ""
    return EFFORTS[length] if gain == 1.0 else ""
