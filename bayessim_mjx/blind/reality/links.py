"""Links of a compiled model: whether they turn, how long they are, about which axis."""

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
