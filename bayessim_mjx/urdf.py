"""Models as people have them: URDF with `package://` meshes and without actuators."""

import fnmatch
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco

from bayessim_mjx import config
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters.attributes import suggest

ALLOWED = "torque, position:KP, position:KP,KV, velocity:KV, or a YAML file with joint: drive"
_AXIAL = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_PACKAGE = re.compile(r"package://([^/\"']+)/([^\"']+)")


def read(path: Path, packages: Sequence[str] = ()) -> mujoco.MjSpec:
    """Read the specification of an MJCF or URDF file; `package://NAME/...` is sought in `packages` and above the file.

    Args:
        packages: `NAME=FOLDER`, or a folder that has folders of these names.

    Raises:
        UserError: no such folder, or a file of a package that is in none of them.
        ValueError: MuJoCo cannot load it.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    if not _PACKAGE.search(text):
        return mujoco.MjSpec.from_file(str(path))
    named, folders = _folders(packages)
    above = [*folders, *path.resolve().parents]

    def found(match: re.Match[str]) -> str:
        name, rest = match.groups()
        roots = [named[name]] if name in named else [f / name for f in above]
        # a file beside its package: .../robot_description/urdf/robot.urdf
        roots += [f for f in path.resolve().parents if f.name == name]
        here = next((root / rest for root in roots if (root / rest).is_file()), None)
        if here is None:
            raise UserError(f"--model {path}: {match[0]}: no such file; allowed: --packages {name}=FOLDER")
        return str(here)

    spec = mujoco.MjSpec.from_string(_with_paths(_PACKAGE.sub(found, text)))
    spec.modelfiledir = str(path.resolve().parent)
    return spec


def _with_paths(text: str) -> str:
    """MuJoCo strips the folders of a URDF's meshes unless its own element in the file says otherwise."""
    if "<mujoco" in text:
        return re.sub(r"<compiler\b(?![^>]*strippath)", '<compiler strippath="false"', text)
    own = '<mujoco><compiler strippath="false"/></mujoco>'
    return re.sub(r"(<robot\b[^>]*>)", lambda m: m[1] + own, text, count=1)


def _folders(packages: Sequence[str]) -> tuple[dict[str, Path], list[Path]]:
    named, folders = {}, []
    for part in packages:
        name, _, folder = part.rpartition("=")
        if not Path(folder).is_dir():
            raise UserError(f"--packages {part}: no folder {folder}; allowed: NAME=FOLDER, or a folder of packages")
        if name:
            named[name] = Path(folder).resolve()
        else:
            folders.append(Path(folder).resolve())
    return named, folders


def drive(spec: mujoco.MjSpec, text: str) -> None:
    """Add an actuator to each joint that moves on its own, of the joint's name, in place.

    Joints that follow another one (`<mimic>`, a joint equality) get none. A limit of effort is the joint's own.

    Args:
        text: `torque`: commands are N m or N; `position:KP,KV` or `velocity:KV`: they are targets, and gains are in
            N m/rad and N m s/rad (N/m, N s/m); a YAML file: {joint, or a pattern: one of these, or none}.

    Raises:
        UserError: the model has actuators already, or it names no drive or joint.
    """
    if spec.actuators:
        names = ", ".join(a.name for a in spec.actuators)
        raise UserError(f"--drive {text}: the model has actuators already ({names}); leave --drive out")
    following = {e.name1 for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT and e.name2}
    free = [j for j in spec.joints if j.type in _AXIAL and j.name not in following]
    for joint, given in _each(text, [j.name for j in free]).items():
        if given != "none":
            _add(spec, joint, given)


def _each(text: str, joints: Sequence[str]) -> dict[str, str]:
    """{joint: drive}."""
    if not text.endswith((".yaml", ".yml")):
        return dict.fromkeys(joints, text)
    raw = config.read_yaml(text)
    if not isinstance(raw, Mapping):
        raise UserError(f"--drive {text}: expected joint: drive; allowed drives: {ALLOWED.partition(', or')[0]}, none")
    out: dict[str, str] = {}
    for pattern, given in raw.items():
        own = [j for j in joints if fnmatch.fnmatchcase(j, str(pattern))]
        if not own:
            raise UserError(
                f"--drive {text}: no joint {pattern!r} that moves on its own; {suggest(str(pattern), joints)}"
            )
        out |= dict.fromkeys(own, str(given))
    return out


def _add(spec: mujoco.MjSpec, joint: str, text: str) -> None:
    kind, _, numbers = text.partition(":")
    try:
        gains = [float(x) for x in numbers.split(",")] if numbers else []
    except ValueError:
        gains = [-1.0]
    counts = {"torque": (0,), "position": (1, 2), "velocity": (1,)}.get(kind)
    if counts is None or len(gains) not in counts or any(not 0 <= g < float("inf") for g in gains):
        raise UserError(f"--drive {text}: no such drive (joint {joint}); allowed: {ALLOWED}")
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if kind == "torque":
        actuator.set_to_motor()
    elif kind == "velocity":
        actuator.set_to_velocity(gains[0])
    else:
        actuator.set_to_position(gains[0], kv=gains[1] if len(gains) > 1 else 0.0)
