"""Mirror symmetry of a robot: declared by the names of its joints and observations, kept as signed permutations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError

SignedPermutation = tuple[np.ndarray, np.ndarray]  # (perm, sign): the image of x is sign * x[..., perm]
AXES = "xyz"


@dataclass(frozen=True)
class Mirror:
    """What a task says: {"hip_1": "-hip_4"} for a left hip that moves like the right one with the sign turned.

    A pair is named once, or both ways; what is not named is its own image. An observation that begins with the name of
    a joint ("hip_1_velocity") follows its joint. Actions follow the joints that they drive.
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


def resolve(mirror: Mirror, model: mujoco.MjModel, groups: Mapping[str, Sequence[str]]) -> MirrorMap:
    """The maps that `mirror` means for this model and the observations called `groups[group]`; UserError."""
    known = {name for names in groups.values() for name in names}
    for name, text in mirror.observations.items():
        if unknown := {name, image(text)[0]} - known:
            raise UserError(f"mirror of observations: there is no {unknown.pop()!r}; there are {', '.join(known)}")
    driven = [_joint_name(model, joint) for joint in model.actuator_trnid[:, 0]]
    qpos, qvel = _of_state(model, mirror)
    return MirrorMap(
        observation={g: signed_permutation(names, _following(names, mirror), g) for g, names in groups.items()},
        action=signed_permutation(driven, {k: v for k, v in mirror.joints.items() if k in driven}, "actuated joints"),
        qpos=qpos,
        qvel=qvel,
        task=tuple(mirror.task),
    )
