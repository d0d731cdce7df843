"""Mirror symmetry of a robot: declared by the names of its joints and observations, kept as signed permutations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError

SignedPermutation = tuple[np.ndarray, np.ndarray]  # (perm, sign): the image of x is sign * x[..., perm]
AXES = "xyz"
POSES = 3  # random ones in which transmissions are compared
PARALLEL = 0.99  # cosine between the mirror image of an actuator's moment and that of its partner
UNEVEN = 0.1  # of the width of ctrlrange, by which partners may differ


@dataclass(frozen=True)
class Mirror:
    """What a task says: {"hip_1": "-hip_4"} for a left hip that moves like the right one with the sign turned.

    A pair is named once, or both ways; what is not named is its own image. An observation that begins with the name of
    a joint ("hip_1_velocity") follows its joint. Actions follow what their actuators do to the mirrored robot.
    """

    joints: Mapping[str, str] = field(default_factory=dict)
    observations: Mapping[str, str] = field(default_factory=dict)  # of all groups
    normal: str | None = None  # world axis that the mirror turns round; needed where a base floats freely
    task: Sequence[str] = ()  # entries of `world.task` that change their sign


@dataclass(frozen=True, eq=False)
class MirrorMap:
    """Signed permutations of each observation group, of actions and of the state.

    Raises:
        UserError: naming the map that is not its own inverse.
    """

    observation: Mapping[str, SignedPermutation]
    action: SignedPermutation
    qpos: SignedPermutation | None = None
    qvel: SignedPermutation | None = None
    task: Sequence[str] = ()

    def __post_init__(self) -> None:
        parts = {"action": self.action, "qpos": self.qpos, "qvel": self.qvel}
        for name, part in [*self.observation.items(), *parts.items()]:
            if part is not None and not is_involution(*part):
                raise UserError(f"mirror of {name}: applied twice it is not the identity (perm, sign = {part})")


def is_involution(perm: np.ndarray, sign: np.ndarray) -> bool:
    """Whether the signed permutation applied twice is the identity."""
    perm, sign = np.asarray(perm), np.asarray(sign)
    whole = perm.shape == sign.shape and sorted(perm) == list(range(len(perm)))
    return whole and bool((perm[perm] == np.arange(len(perm))).all() and (sign * sign[perm] == 1).all())


def image(text: str) -> tuple[str, int]:
    """("hip_4", -1) of "-hip_4"."""
    return (text[1:], -1) if text.startswith("-") else (text, 1)


def _both_ways(images: Mapping[str, str], what: str) -> dict[str, tuple[str, int]]:
    """name -> (name of its image, sign), each pair in both directions."""
    whole: dict[str, tuple[str, int]] = {}
    for name, text in images.items():
        other, sign = image(text)
        for a, b in ((name, other), (other, name)):
            if whole.setdefault(a, (b, sign)) != (b, sign):
                raise UserError(f"mirror of {what}: {name!r} goes to {text!r}, but {a!r} also to {whole[a]}: no pairs")
    return whole


def signed_permutation(names: Sequence[str], images: Mapping[str, str], what: str) -> SignedPermutation:
    """(perm [n] int, sign [n] float32) of `names` by the images of some of them.

    Raises:
        UserError: for a name that does not exist, and for one with two images or signs.
    """
    index = {name: i for i, name in enumerate(names)}
    perm, sign = np.arange(len(names)), np.ones(len(names), np.float32)
    for name, (other, turn) in _both_ways(images, what).items():
        for known in (name, other):
            if known not in index:
                raise UserError(f"mirror of {what}: there is no {known!r}; there are {', '.join(names)}")
        perm[index[name]], sign[index[name]] = index[other], turn
    return perm, sign


def _following(names: Sequence[str], mirror: Mirror) -> dict[str, str]:
    """Images of the observations `names`: as declared, else those of the joint at the beginning of the name."""
    joints, declared = _both_ways(mirror.joints, "joints"), _both_ways(mirror.observations, "observations")
    images = {}
    for name in names:
        joint = next((j for j in joints if name == j or name.startswith(f"{j}_")), None)
        if name in declared:
            other, sign = declared[name]
        elif joint is not None:
            other, sign = joints[joint][0] + name[len(joint) :], joints[joint][1]
        else:
            continue
        images[name] = "-" * (sign < 0) + other
    return images


def _joint_name(model: mujoco.MjModel, index: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, index) or f"{index}"


def _free(normal: str | None, name: str) -> tuple[list[int], list[int]]:
    """Signs of (x, y, z, quaternion) and of (velocity, angular velocity) in a mirror with this normal."""
    if normal not in tuple(AXES):
        raise UserError(f"mirror: the joint {name!r} floats freely: normal = {normal!r}, expected x, y or z")
    polar = [-1 if axis == normal else 1 for axis in AXES]
    axial = [-sign for sign in polar]
    return [*polar, 1, *axial], [*polar, *axial]


def _coordinates(model: mujoco.MjModel, mirror: Mirror) -> Iterator[tuple[str, list[int], list[int]]]:
    """(joint, signs of its positions, signs of its velocities), in MuJoCo's order."""
    for i, kind in enumerate(model.jnt_type):
        name = _joint_name(model, i)
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            raise UserError(f"mirror: the joint {name!r} is a ball; hinges, slides and free joints have mirror images")
        yield name, *(_free(mirror.normal, name) if kind == mujoco.mjtJoint.mjJNT_FREE else ([1], [1]))


def _of_state(model: mujoco.MjModel, mirror: Mirror) -> tuple[SignedPermutation, SignedPermutation]:
    joints = list(_coordinates(model, mirror))
    order, turned = signed_permutation([name for name, _, _ in joints], mirror.joints, "joints")

    def of(which: int) -> SignedPermutation:
        signs = [joint[which] for joint in joints]
        starts = np.cumsum([0, *(len(s) for s in signs)])
        perm = [starts[j] + np.arange(len(signs[i])) for i, j in enumerate(order)]
        sign = [turned[i] * np.asarray(s, np.float32) for i, s in enumerate(signs)]
        return np.concatenate(perm), np.concatenate(sign).astype(np.float32)

    return of(1), of(2)


def _of_actuators(model: mujoco.MjModel, qpos: SignedPermutation, qvel: SignedPermutation) -> SignedPermutation:
    """Each actuator's partner, which does to the mirrored robot what it does to the robot, and the sign between them.

    Told by the moments in a few poses and their mirror images, so that gears, tendons and sites need no rules of their
    own; of several that do, by the numbers of the actuators (a servo and a damper on one joint).

    Raises:
        UserError: naming an actuator without a partner.
    """
    cosine, names = _alikeness(model, qpos, qvel), [_actuator_name(model, i) for i in range(model.nu)]
    perm, signs = np.full(model.nu, -1), np.ones(model.nu, np.float32)
    for i in range(model.nu):
        if perm[i] >= 0:
            continue
        able = [k for k in range(i, model.nu) if perm[k] < 0 and _of_one_kind(model, i, k, cosine[i, k])]
        if not able:
            raise UserError(
                f"mirror: no actuator does to the mirrored robot what {names[i]!r} does to the robot (there are "
                f"{', '.join(names)}); allowed: partners of one kind, with gears, gains and ctrlrange that are mirror "
                "images"
            )
        k = able[int(np.argmin([_difference(model, i, k, float(cosine[i, k])) for k in able]))]
        perm[i], perm[k] = k, i
        signs[i] = signs[k] = _command_sign(model, i, k, cosine[i, k])
    return perm, signs


def _alikeness(model: mujoco.MjModel, qpos: SignedPermutation, qvel: SignedPermutation) -> np.ndarray:
    """[nu, nu], cosine between the mirror image of what actuator i does and what k does to the mirrored robot."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    here, there = [], []
    for _ in range(POSES):
        pose = np.array(model.qpos0)
        mujoco.mj_integratePos(model, pose, rng.uniform(-0.7, 0.7, model.nv), 1.0)
        here.append(_moments(model, data, pose)[:, qvel[0]] * qvel[1])
        there.append(_moments(model, data, qpos[1] * pose[qpos[0]]))
    one, two = np.concatenate(here, axis=1), np.concatenate(there, axis=1)
    size = np.linalg.norm(one, axis=1)[:, None] * np.linalg.norm(two, axis=1)
    return np.divide(one @ two.T, size, out=np.ones_like(size), where=size > 0)


def _moments(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> np.ndarray:
    """[nu, nv], the generalised force of one unit of each actuator's force."""
    data.qpos[:] = pose
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission):
        stage(model, data)
    moments = np.zeros((model.nu, model.nv))
    if model.nu:
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(moments, data.actuator_moment, *rows)
    return moments


def _actuator_name(model: mujoco.MjModel, index: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, index) or f"actuator{index}"


def _of_one_kind(model: mujoco.MjModel, i: int, k: int, cosine: float) -> bool:
    """Whether actuator k can be the partner of i: it pushes along the mirror image, by the same law and limits."""
    kinds = (model.actuator_trntype, model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)
    linear = model.actuator_gaintype[i] <= int(mujoco.mjtGain.mjGAIN_AFFINE)
    linear &= model.actuator_biastype[i] <= int(mujoco.mjtBias.mjBIAS_AFFINE)
    return (
        abs(cosine) > PARALLEL
        and all(kind[i] == kind[k] for kind in kinds)
        and (cosine > 0 or bool(linear))  # a muscle only pulls
        and model.actuator_ctrllimited[i] == model.actuator_ctrllimited[k]
        and _range_is_image(model, i, k, _command_sign(model, i, k, cosine))
    )


def _command_sign(model: mujoco.MjModel, i: int, k: int, cosine: float) -> float:
    """-1 where the partner has to be commanded the other way: it pushes the other way, or its gain is the other way."""
    gain = model.actuator_gainprm[i, 0] * model.actuator_gainprm[k, 0]
    return -1.0 if (cosine < 0) != (gain < 0) else 1.0


def _range_is_image(model: mujoco.MjModel, i: int, k: int, sign: float) -> bool:
    """Whether k's ctrlrange is about the image of i's."""
    own, other = np.sort(sign * model.actuator_ctrlrange[i]), model.actuator_ctrlrange[k]
    return not model.actuator_ctrllimited[i] or bool(np.all(np.abs(other - own) <= UNEVEN * np.ptp(own)))


def _difference(model: mujoco.MjModel, i: int, k: int, cosine: float) -> float:
    """How far the numbers of actuator k are from those of i's image, relative ones added up."""
    command, length = _command_sign(model, i, k, cosine), -1.0 if cosine < 0 else 1.0
    # force = (g0 + g1 l + g2 l') u + b0 + b1 l + b2 l'; force and l change by `length`, u by `command`
    gain, bias = np.ones(model.actuator_gainprm.shape[1]), np.ones(model.actuator_biasprm.shape[1])
    gain[:3], bias[0] = (command * length, command, command), length
    gear = np.linalg.norm(model.actuator_gear, axis=1)
    pairs = (
        (gain * model.actuator_gainprm[i], model.actuator_gainprm[k]),
        (bias * model.actuator_biasprm[i], model.actuator_biasprm[k]),
        (model.actuator_dynprm[i], model.actuator_dynprm[k]),
        (gear[i : i + 1], gear[k : k + 1]),
    )
    return sum(float(np.linalg.norm(a - b) / (np.linalg.norm(a) + np.linalg.norm(b) + 1e-12)) for a, b in pairs)


def joints_by_side(model: mujoco.MjModel, sides: tuple[str, str], normal: str = "y") -> dict[str, str]:
    """`Mirror.joints` of a robot whose joints are named after their sides, ("left", "right"); signs by their axes.

    Raises:
        UserError: naming a joint that turns about no mirror image of its partner's axis in the pose qpos0.
    """
    data, names = mujoco.MjData(model), [_joint_name(model, i) for i in range(model.njnt)]
    mujoco.mj_kinematics(model, data)
    polar = np.array([-1.0 if axis == normal else 1.0 for axis in AXES])
    images = {}
    for i, name in enumerate(names):
        others = (name.replace(*sides, 1), name.replace(*sides[::-1], 1))
        k = next((names.index(other) for other in others if other != name and other in names), i)
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE or names[k] in images:
            continue
        hinge = model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE
        cosine = float((-polar if hinge else polar) * data.xaxis[i] @ data.xaxis[k])
        if abs(cosine) < PARALLEL:
            raise UserError(
                f"mirror: the axis of {names[k]!r} is not the mirror image of {name!r}'s; name the pairs by hand"
            )
        images[name] = "-" * (cosine < 0) + names[k]
    return images


def resolve(mirror: Mirror, model: mujoco.MjModel, groups: Mapping[str, Sequence[str]]) -> MirrorMap:
    """Find the maps that `mirror` means for this model and the observations called `groups[group]`; UserError."""
    known = {name for names in groups.values() for name in names}
    for name, text in mirror.observations.items():
        if unknown := {name, image(text)[0]} - known:
            raise UserError(f"mirror of observations: there is no {unknown.pop()!r}; there are {', '.join(known)}")
    qpos, qvel = _of_state(model, mirror)
    return MirrorMap(
        observation={g: signed_permutation(names, _following(names, mirror), g) for g, names in groups.items()},
        action=_of_actuators(model, qpos, qvel),
        qpos=qpos,
        qvel=qvel,
        task=tuple(mirror.task),
    )
