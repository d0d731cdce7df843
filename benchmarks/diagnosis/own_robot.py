"""Constants of a robot, out of its compiled model, for equations of motion that are not MuJoCo's (`own_motion.py`)."""

import dataclasses

import mujoco
import numpy as np

# rad/s, of the inertia at a joint against its stop. 1 N m bends the flanks of the smallest joint here (5e-3 kg m^2) by
# 5e-5 rad, an eighth of its encoder's noise; a step of 1e-4 s is a thirtieth of a period
STOP = 2000.0
RESTITUTION = 0.3  # damping ratio of a stop: a link comes back from it with about a third of its speed
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
NONE, FILTER = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """Constants of n joints, of the nb bodies that they move and of nu actuators.

    Attributes:
        parent: [n] the joint before, -1 at the ground. turn, way: [n, 3, 3] and [n, 3] m, where each joint's frame lies
            in that of the joint before, its origin in the joint; axis: [n, 3] in it. hinge: [n] 1 of hinges, 0 of
            slides. zero: [n] positions in which the model is written.
        bodies: [nb] their numbers in the model; link: [nb] the last joint that moves each; centre, inertia, mass: its
            centre of mass and inertia about it, in the frame of that joint. moves: [nb, n] 1 where a joint moves a
            body; before: [n, n] 1 where the second joint moves the first one.
        rotor: [n] kg m^2 or kg of armatures; gravity: [3]; damping, spring: [n, 3] coefficients of powers; rest: [n].
        low, high, stop, wear: [n] range of each joint, stiffness and damping of its stops.
        gear: [nu, n]; limit: [nu, 2] of commands; lag: [nu] s, 0 without a filter; forced: [nu] 1 where forces have a
            limit.
    """

    parent: np.ndarray
    turn: np.ndarray
    way: np.ndarray
    axis: np.ndarray
    hinge: np.ndarray
    zero: np.ndarray
    bodies: np.ndarray
    link: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    mass: np.ndarray
    moves: np.ndarray
    before: np.ndarray
    rotor: np.ndarray
    gravity: np.ndarray
    damping: np.ndarray
    spring: np.ndarray
    rest: np.ndarray
    low: np.ndarray
    high: np.ndarray
    stop: np.ndarray
    wear: np.ndarray
    gear: np.ndarray
    limit: np.ndarray
    lag: np.ndarray
    forced: np.ndarray

    def key(self) -> tuple[bytes, ...]:
        """Equal of robots with equal constants."""
        return tuple(getattr(self, f.name).tobytes() for f in dataclasses.fields(self))


def robot(model: mujoco.MjModel) -> Robot:
    """The constants of a compiled model.

    Raises:
        ValueError: the model has something that these equations lack.
    """
    _refuse(model)
    tree = _tree(model)
    gear = np.zeros((model.nu, model.nv))
    gear[np.arange(model.nu), model.actuator_trnid[:, 0]] = model.actuator_gear[:, 0]
    limited = model.actuator_ctrllimited.astype(bool)[:, None]
    ends = np.where(model.jnt_limited.astype(bool)[:, None], model.jnt_range, [-np.inf, np.inf])
    inertia = 1 / model.dof_invweight0
    return Robot(
        **tree,
        axis=model.jnt_axis.copy(),
        hinge=(model.jnt_type == HINGE).astype(float),
        zero=model.qpos0.copy(),
        mass=model.body_mass[tree["bodies"]],
        rotor=model.dof_armature.copy(),
        gravity=model.opt.gravity.copy(),
        damping=np.column_stack([model.dof_damping, model.dof_dampingpoly]),
        spring=np.column_stack([model.jnt_stiffness, model.jnt_stiffnesspoly]),
        rest=model.qpos_spring.copy(),
        low=ends[:, 0],
        high=ends[:, 1],
        stop=inertia * STOP**2,
        wear=2 * RESTITUTION * inertia * STOP,
        gear=gear,
        limit=np.where(limited, model.actuator_ctrlrange, [-np.inf, np.inf]),
        lag=np.where(model.actuator_dyntype == FILTER, model.actuator_dynprm[:, 0], 0.0),
        forced=model.actuator_forcelimited.astype(float),
    )


def _refuse(model: mujoco.MjModel) -> None:
    joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    lacking = {
        "balls or free joints": not np.isin(model.jnt_type, (HINGE, SLIDE)).all(),
        "tendons or equalities": model.ntendon or model.neq,
        "contacts": (model.geom_contype.any() and model.geom_conaffinity.any()) or model.npair,
        "dry friction of its own": model.dof_frictionloss.any(),
        "gravity compensation": model.body_gravcomp.any(),
        "a fluid": model.opt.density or model.opt.viscosity or model.opt.wind.any(),
        "another filter of an actuator": not np.isin(model.actuator_dyntype, (NONE, FILTER)).all(),
        "an actuator off the joints": (model.actuator_trntype != joint).any() or model.actuator_damping.any(),
        "forces limited by joint": model.jnt_actfrclimited.any(),
    }
    if found := [text for text, there in lacking.items() if there]:
        raise ValueError(f"the model has {', '.join(found)}: its motion is not written down here")


def _tree(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Frames of joints in those before them, and of bodies in that of the last joint that moves them."""
    n = model.nv
    parent, turn, way = np.full(n, -1), np.zeros((n, 3, 3)), np.zeros((n, 3))
    # of each body: its last joint, and its axes and origin in that joint's frame
    last, axes, origin = [-1], [np.eye(3)], [np.zeros(3)]
    for b in range(1, model.nbody):
        above = int(model.body_parentid[b])
        joint, turned = last[above], axes[above] @ _matrix(model.body_quat[b])
        at = origin[above] + axes[above] @ model.body_pos[b]
        for k in range(model.body_jntnum[b]):
            i = model.body_jntadr[b] + k
            parent[i], turn[i], way[i] = joint, turned, at + turned @ model.jnt_pos[i]
            joint, turned, at = i, np.eye(3), -model.jnt_pos[i]
        last.append(joint)
        axes.append(turned)
        origin.append(at)
    moves = np.eye(n)
    for i in range(n):
        moves[i] += moves[parent[i]] if parent[i] >= 0 else 0.0
    bodies = np.array([b for b in range(1, model.nbody) if last[b] >= 0])
    link = np.array([last[b] for b in bodies])
    about = [axes[b] @ _matrix(model.body_iquat[b]) for b in bodies]
    inertia = np.array([r @ np.diag(model.body_inertia[b]) @ r.T for b, r in zip(bodies, about, strict=True)])
    centre = np.array([origin[b] + axes[b] @ model.body_ipos[b] for b in bodies])
    places = {"parent": parent, "turn": turn, "way": way, "bodies": bodies, "link": link}
    return places | {"centre": centre, "inertia": inertia, "moves": moves[link], "before": moves - np.eye(n)}


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """[3, 3] of a rotation (w, x, y, z)."""
    w, v = quaternion[0], quaternion[1:]
    return np.eye(3) + 2 * w * across(v) + 2 * across(v) @ across(v)


def across(v: np.ndarray) -> np.ndarray:
    """[3, 3] that takes x to v x x."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
