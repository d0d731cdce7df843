"""Models as people have them: URDF with `package://` meshes and without actuators."""

import fnmatch
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from bayessim_mjx import config
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters.attributes import suggest

ALLOWED = "torque, position:KP, position:KP,KV, velocity:KV, or a YAML file with joint: drive"
_AXIAL = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
SAME = 1e-9  # of a link's largest inertia: smaller differences are rounding of double precision
_MOMENTS = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
_PACKAGE = re.compile(r"package://([^/\"']+)/([^\"']+)")


def read(path: Path, packages: Sequence[str] = ()) -> mujoco.MjSpec:
    """Read the specification of an MJCF or URDF file; `package://NAME/...` is sought in `packages` and above the file.

    Args:
        packages: `NAME=FOLDER`, or a folder that has folders of these names.

    Raises:
        UserError: no such folder, or a file of a package that is in none of them.
        ValueError: MuJoCo cannot load it.
    """
    if not is_urdf(path):
        return mujoco.MjSpec.from_file(str(path.absolute()))  # so that its folder is known
    text = path.read_text(encoding="utf-8", errors="replace")
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

    spec = mujoco.MjSpec.from_string(_with_paths(_PACKAGE.sub(found, text)) if _PACKAGE.search(text) else text)
    spec.modelfiledir = str(path.resolve().parent)
    return spec


def load(path: Path, text: str | None = None, packages: Sequence[str] = ()) -> mujoco.MjSpec:
    """Read a file with the drives that a URDF needs; text: see `drive`.

    Raises:
        UserError: there is no such file, MuJoCo cannot load it, or see `read` and `drive`.
    """
    if not path.is_file():
        what = "a folder; give the file in it" if path.is_dir() else "no such file"
        raise UserError(f"--model {path}: {what}")
    try:
        spec = read(path, packages)
    except ValueError as error:
        lines = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
        raise UserError(f"{path}: MuJoCo cannot load it: {lines}") from None
    if text is not None:
        drive(spec, text)
    return spec


def check_names(model: mujoco.MjModel, source: str) -> None:
    """Refuse a model without motion or commands."""
    if not model.njnt:
        raise UserError(f"{source}: the model has no joint, so there is no motion to compare")
    if not model.nu:
        raise UserError(
            f"{source}: the model has no actuator, so the logged commands cannot act on it; allowed: --drive torque "
            "(the logs have efforts), --drive position:KP,KV (they have targets), or --drive FILE.yaml by joint"
        )


def is_urdf(path: Path) -> bool:
    """Whether the first element of a file is that of a URDF; only its beginning is read."""
    try:
        with path.open("rb") as file:
            return next(ElementTree.iterparse(file, events=("start",)))[1].tag == "robot"
    except (ElementTree.ParseError, StopIteration):  # MuJoCo says what is wrong with it
        return False


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


def corrected(source: Path, nominal: mujoco.MjModel, found: mujoco.MjModel) -> str:
    """Return the text of a URDF with what differs between two models of it: `<dynamics>` of joints, `<inertial>`.

    A link that MuJoCo fused with others takes the whole difference. Meshes that lie beside the file get their full
    paths, so that the text may lie elsewhere.

    Args:
        found: `nominal` with other numbers.
    """
    root = ElementTree.parse(source, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))
    for joint in root.getroot().findall("joint"):
        _write_dynamics(joint, nominal, found)
    for link in root.getroot().findall("link"):
        _write_inertial(link, nominal, found)
    for mesh in root.iter("mesh"):
        beside = source.resolve().parent / mesh.get("filename", "")
        if beside.is_file():
            mesh.set("filename", str(beside))
    return ElementTree.tostring(root.getroot(), encoding="unicode") + "\n"


def _write_dynamics(joint: ElementTree.Element, nominal: mujoco.MjModel, found: mujoco.MjModel) -> None:
    name = joint.get("name", "")
    if name not in {nominal.joint(j).name for j in range(nominal.njnt)}:
        return
    before, after = (int(m.joint(name).dofadr[0]) for m in (nominal, found))
    for attribute, field in (("damping", "dof_damping"), ("friction", "dof_frictionloss")):
        old, new = getattr(nominal, field)[before], getattr(found, field)[after]
        if old != new:
            _child(joint, "dynamics").set(attribute, f"{new:.9g}")


def _write_inertial(link: ElementTree.Element, nominal: mujoco.MjModel, found: mujoco.MjModel) -> None:
    name = link.get("name", "")
    if name not in {nominal.body(b).name for b in range(nominal.nbody)}:
        return
    before = _inertia(nominal, name)
    change = _inertia(found, name) - before
    if np.abs(change).max() <= SAME * np.abs(before).max():
        return
    own = link.find("inertial")
    total = change + (before if own is None else _stated(own))  # without one its mass is that of its geometry
    origin, mass, moments = (_child(_child(link, "inertial"), tag) for tag in ("origin", "mass", "inertia"))
    heavy, place = total[3, 3], total[3, :3] / total[3, 3]
    about = total[:3, :3] - heavy * (place @ place * np.eye(3) - np.outer(place, place))
    origin.attrib |= {"xyz": " ".join(f"{x:.9g}" for x in place), "rpy": "0 0 0"}
    mass.set("value", f"{heavy:.9g}")
    moments.attrib |= {key: f"{about[at]:.9g}" for key, at in _MOMENTS.items()}


def _stated(inertial: ElementTree.Element) -> np.ndarray:
    """`[4, 4]` of an `<inertial>`; see `_about_origin`."""
    origin, mass, moments = (_child(inertial, tag) for tag in ("origin", "mass", "inertia"))
    own, (place, rpy) = np.zeros((3, 3)), (np.array(origin.get(k, "0 0 0").split(), float) for k in ("xyz", "rpy"))
    for key, (row, column) in _MOMENTS.items():
        own[row, column] = own[column, row] = float(moments.get(key, "0"))
    turn = _turned(rpy)
    return _about_origin(float(mass.get("value", "0")), place, turn @ own @ turn.T)


def _inertia(model: mujoco.MjModel, name: str) -> np.ndarray:
    """`[4, 4]` of a body; see `_about_origin`."""
    body, matrix = model.body(name).id, np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.body_iquat[body])
    turn = matrix.reshape(3, 3)
    own = turn @ np.diag(model.body_inertia[body]) @ turn.T
    return _about_origin(float(model.body_mass[body]), model.body_ipos[body], own)


def _about_origin(mass: float, place: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """`[4, 4]`: inertia about the link's origin, mass times place, mass; those of parts of a link add up."""
    out = np.zeros((4, 4))
    out[:3, :3] = inertia + mass * (place @ place * np.eye(3) - np.outer(place, place))
    out[3, :3] = out[:3, 3] = mass * place
    out[3, 3] = mass
    return out


def _turned(rpy: np.ndarray) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _child(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Find the child with this tag; it is made where there is none."""
    found = parent.find(tag)
    return ElementTree.SubElement(parent, tag) if found is None else found
