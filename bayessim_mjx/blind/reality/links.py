"""Links of a compiled model: whether they turn, how long they are, about which axis."""

from collections.abc import Sequence

import mujoco
import numpy as np


def turns(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body with joints of its own and mass is turned, alone or with those before it."""
    diagonal = model.body_dofnum[body] > 1 and model.body_simple[body] == 1  # compiled so: no other inertia is taken
    if model.body_weldid[body] != body or model.body_mass[body] <= 0 or diagonal:
        return False
    while body:
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        if any(int(k) != int(mujoco.mjtJoint.mjJNT_SLIDE) for k in model.jnt_type[first : first + count]):
            return True
        body = int(model.body_parentid[body])
    return False


def length(model: mujoco.MjModel, body: int) -> float:
    """m, of a rod of the same mass and largest inertia: m l^2 / 12."""
    return float(np.sqrt(12 * model.body_inertia[body].max() / model.body_mass[body]))


def axis(model: mujoco.MjModel, body: int) -> np.ndarray:
    """`[3]`, of the one hinge that a body has, in its frame; zeros where it has none, or several."""
    own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    hinges = [i for i in own if int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_HINGE)]
    return model.jnt_axis[hinges[0]].copy() if len(hinges) == 1 else np.zeros(3)


def chain(model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, tuple[str, str]]:
    """(joint before, first joint behind) of each; a joint of another kind in between parts them."""
    before: dict[str, str] = {}
    for name in joints:
        at = model.joint(name).id
        body = int(model.jnt_bodyid[at])
        way = [i for i in range(model.body_jntadr[body], at)]  # those of its own body that come first
        while not way and body:
            body = int(model.body_parentid[body])
            way = list(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))
        last = model.joint(way[-1]).name if way else ""
        before[name] = last if last in joints else ""
    behind = {other: name for name, other in reversed(before.items()) if other}
    return {name: (before[name], behind.get(name, "")) for name in joints}
