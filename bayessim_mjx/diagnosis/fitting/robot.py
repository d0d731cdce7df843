"""The robot under diagnosis, from a task or an MJCF: a model that MJX can simulate, parameters, control step."""

import copy
import dataclasses
import glob
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import mujoco
import numpy as np

from bayessim_mjx import config, urdf
from bayessim_mjx.config import foreign
from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.effects.support.bodies import whole_inertia
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.parameters import ParameterSpace, elements
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.native import FrictionLoss, moved_to_joints
from bayessim_mjx.physics.visuals import needs_geoms, with_options, without_meshes, without_visuals

if TYPE_CHECKING:
    from bayessim_mjx.env import Task


from bayessim_mjx.physics import mjx
from bayessim_mjx.physics.native import absent

TRAINING = ("frequency", "observations", "actions", "sim_params")
# The default range of a scale: of Gaussian errors of 30 % (`data_sheet.ACCURACY`, the least accurate data sheet that is
# expected: a rule of thumb) all but 1 in 100 lie within it. What is known of a number is its prior; the range ends it.
WITHIN = (0.3, 2.0)
# and of dry friction, which falls by half and more as a drive warms up or wears in: more of it can be an effect
# (Coulomb friction), less can be nothing else. Not counted
RUBS = (0.2, 1.2)
# Iterations of Newton's solver and of its line search. Measured: dry friction is solved to single precision by 4 and 6;
# with six joints, half a second, the same to 1e-7 rad as by 100 and 50, at half the time. Equality constraints are
# quadratic, which one step solves; where they are alone no step is needed (`physics.timestep`).
ROUNDS = 8
_IMPLICIT = int(mujoco.mjtIntegrator.mjINT_IMPLICIT)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """What a diagnosis needs of a robot.

    Attributes:
        mj_model: the nominal model.
        spec: gives a fresh specification that compiles to it; None: only the compiled model is known.
        control_dt: s; None: the logs' own period holds.
        space: the parameters that the simulator already has and may recalibrate.
        name: the task's, or the file's without its ending.
        max_qvel: the task's limit of simulated speeds, see `Physics`.
        accuracy: {parameter: standard deviation as a share}, of what a data sheet states; rating: {body: kg carried}.
        assumed: those of them whose accuracy nobody stated.
        unlimited: joints whose limits its physics leaves out; rounds: most iterations of its solver (`pruned`).
        urdf: the URDF file that it was read from, if it was.
        rubbing: joints whose frictionloss is simulated without the solver (`native.FrictionLoss`).
        lean: the model that is simulated with the options of `mj_model`, where that one has meshes only to look at.
    """

    mj_model: mujoco.MjModel
    spec: Callable[[], mujoco.MjSpec] | None
    control_dt: float | None
    space: ParameterSpace
    name: str
    max_qvel: float | Sequence[float] | None = None
    accuracy: Mapping[str, float] = dataclasses.field(default_factory=dict)
    rating: Mapping[int, float] = dataclasses.field(default_factory=dict)
    assumed: frozenset[str] = frozenset()
    unlimited: tuple[int, ...] = ()
    rounds: int | None = None
    urdf: Path | None = None
    lean: mujoco.MjModel | None = None
    rubbing: tuple[str, ...] = ()

    def stated(self, accuracy: Sequence[str] = (), payload: Sequence[str] = ()) -> "Robot":
        """With what was said of its data sheet, as `--accuracy` and `--payload` (`data_sheet`)."""
        shares = data_sheet.accuracies(accuracy, self.space, None)
        rated = data_sheet.rating(payload, self.mj_model)
        own = dataclasses.replace(self, accuracy={**self.accuracy, **shares}, assumed=self.assumed - shares.keys())
        return dataclasses.replace(own, rating={**self.rating, **rated})

    def _from_data_sheet(self, own: bool) -> "Robot":
        """Take a model's own numbers for a data sheet's; ranges of a file say themselves what is known."""
        accuracy = data_sheet.accuracies((), self.space, data_sheet.ACCURACY) if own else {}
        return dataclasses.replace(self, accuracy=accuracy, assumed=frozenset(accuracy))

    def physics(
        self, control_dt: float, effects: Sequence[Effect] = (), space: ParameterSpace | None = None
    ) -> Physics:
        """Return the robot at control steps of `control_dt` s, with `space` in the place of its own parameters."""
        model = self.mj_model if self.lean is None else with_options(self.lean, self.mj_model)
        model = with_timestep(model, control_dt)
        model.jnt_limited[list(self.unlimited)] = 0
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)  # a diagnosis compares states
        if self.rounds is not None:
            model.opt.iterations = min(self.rounds, model.opt.iterations)
            model.opt.ls_iterations = min(self.rounds, model.opt.ls_iterations)
        if self.rubbing:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
            effects = (*effects, FrictionLoss(self.rubbing))
        return Physics(model, control_dt, self.space if space is None else space, effects, self.max_qvel)


def pruned(robot: Robot, logs: Sequence[Log], dt: float) -> Robot:
    """Return the robot as simulated beside these logs at control steps of `dt` s: without what they never reach."""
    robot = dataclasses.replace(robot, unlimited=unreached(robot.mj_model, logs))
    return robot if contacts(robot.physics(dt)) else dataclasses.replace(robot, rounds=ROUNDS)


Source: TypeAlias = str | Path | mujoco.MjSpec | mujoco.MjModel | Robot


def robot_of(source: Source, parameters: str | Path | None = None) -> Robot:
    """Return the robot of an MJCF file, a MuJoCo specification or a compiled model; a robot as it is.

    Args:
        parameters: a params.yaml; None: the default space, or the robot's own.

    Raises:
        UserError: see `of_file`.
    """
    if isinstance(source, Robot):
        if parameters is None:
            return source
        space = read_params(parameters, source.mj_model)
        lean = None if needs_geoms(space) else source.lean
        return dataclasses.replace(source, space=space, accuracy={}, assumed=frozenset(), lean=lean)
    if isinstance(source, mujoco.MjModel):
        name = bytes(source.names).split(b"\0")[0].decode() or "model"
        check_simulable(source, name)
        return Robot(source, None, None, _space(source, parameters), name)._from_data_sheet(parameters is None)
    if isinstance(source, mujoco.MjSpec):
        return _of_spec(source.copy(), source.modelname or "model", source.modelname, parameters)
    return of_file(source, parameters)


def of_task(env: "Task", parameters: str | Path | None = None) -> Robot:
    """Return the robot of one of our own tasks (`registry.make`); parameters: a params.yaml, None: the default space.

    Raises:
        UserError: the task is not MuJoCo's, or the file is wrong.
    """
    if not hasattr(env, "physics") or not hasattr(env, "spec"):
        raise UserError(f"--task {env.name}: it has no MuJoCo model of ours; give its MJCF with --model")
    check_simulable(env.mj_model, f"--task {env.name}")
    space, limit = _space(env.mj_model, parameters), env.physics.max_qvel
    robot = Robot(env.mj_model, env.spec, env.dt, space, env.name, None if limit is None else limit.tolist())
    return robot._from_data_sheet(parameters is None)


def of_file(
    path: str | Path, parameters: str | Path | None = None, drive: str | None = None, packages: Sequence[str] = ()
) -> Robot:
    """Return the robot of an MJCF (or URDF) file with hinge or slide joints and actuators.

    Args:
        drive: of a file without actuators, see `urdf.drive`; packages: see `urdf.read`.

    Raises:
        UserError: the file is missing, MuJoCo cannot load it, it has nothing to diagnose, or MJX lacks a feature.
    """
    path = Path(path)
    robot = _of_spec(urdf.load(path, drive, packages), str(path), path.stem, parameters)
    return dataclasses.replace(robot, urdf=path) if urdf.is_urdf(path) else robot


def names_of(path: str | Path, drive: str | None = None, packages: Sequence[str] = ()) -> mujoco.MjModel:
    """Return a model of a file that has its joints and actuators, but no meshes and not its masses.

    Raises:
        UserError: the file is missing, MuJoCo cannot load it, or it has no joint or actuator.
    """
    spec = urdf.load(Path(path), drive, packages)
    model = _by_mujoco("compile", str(path), lambda: without_meshes(spec))
    urdf.check_names(model, str(path))
    return model


def _of_spec(spec: mujoco.MjSpec, source: str, name: str, parameters: str | Path | None) -> Robot:
    if int(spec.option.integrator) == _IMPLICIT:
        text = f"{source}: MJX has no integrator implicit; implicitfast is used (no Coriolis terms)"
        warnings.warn(text, stacklevel=3)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    moved_to_joints(spec)
    model = whole_inertia(spec, _by_mujoco("compile", source, spec.compile))
    lean = _by_mujoco("compile", source, lambda: without_visuals(spec, model))
    check_simulable(model, source, lean)
    space = _space(model, parameters)
    shown = lean is model or needs_geoms(space)
    return Robot(model, spec.copy, None, space, name, lean=None if shown else lean)._from_data_sheet(parameters is None)


def _by_mujoco(does: str, source: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except ValueError as error:
        raise UserError(f"{source}: MuJoCo cannot {does} it: {one_line(error)}") from None


def with_timestep(model: mujoco.MjModel, control_dt: float) -> mujoco.MjModel:
    """Return a copy whose timestep is the largest that divides `control_dt` s and is no longer than the model's own."""
    if not control_dt > 0:
        raise ValueError(f"control_dt = {control_dt} s: must be positive")
    substeps = max(1, math.ceil(control_dt / model.opt.timestep - 1e-6))
    model = copy.copy(model)
    model.opt.timestep = control_dt / substeps
    return model


def _space(model: mujoco.MjModel, parameters: str | Path | None) -> ParameterSpace:
    return default_space(model) if parameters is None else read_params(parameters, model)


def default_space(model: mujoco.MjModel) -> ParameterSpace:
    """Scales of damping, armature, dry friction and mass, .3 to 2, wherever the model has some that can move.

    Dry friction .2 to 1.2: more can be an effect. The mass of a body scales its inertia too. Names are those of the
    loop: `<joint>_damping_mult` ...
    """
    joints = [j for j in range(model.njnt) if model.jnt_type[j] != _FREE]
    dofs = model.jnt_dofadr[joints]
    sizes = {"damping": model.dof_damping, "armature": model.dof_armature, "friction": model.dof_frictionloss}
    having = {
        a: [label(model, "joint", j) for j, d in zip(joints, dofs, strict=True) if size[d] > 0]
        for a, size in sizes.items()
    }
    moving = np.flatnonzero((model.body_weldid != 0) & (model.body_mass > mujoco.mjMINVAL))
    heavy = [label(model, "body", int(b)) for b in moving]
    groups = {"dof_properties": having, "rigid_body_properties": {"mass": heavy}}
    section = {
        g: {a: _scale(found, RUBS if a == "friction" else WITHIN) for a, found in members.items() if found}
        for g, members in groups.items()
    }
    return ParameterSpace.from_config({"actor_params": {_whole(model): section}}, model)


def _scale(include: Sequence[str], within: tuple[float, float]) -> dict[str, Any]:
    return {"range": list(within), "operation": "scaling", "include": [glob.escape(name) for name in include]}


def _whole(model: mujoco.MjModel) -> str:
    """Return a name of the whole model as an actor: none of its bodies is called so."""
    name = elements.WHOLE
    while name in {model.body(b).name for b in range(model.nbody)}:
        name += "_"
    return name


def _of_training(raw: Any) -> list[str]:
    """Keys of the section that are about training: a diagnosis takes its noise from the logs."""
    section = raw.get("task") if isinstance(raw.get("task"), dict) else raw
    section = section.get("randomization_params", section)
    return [key for key in TRAINING if isinstance(section, dict) and section.get(key) not in (None, 1)]


def read_params(path: str | Path, model: mujoco.MjModel) -> ParameterSpace:
    """Return the space of a params.yaml in the loop's format.

    The file holds `task: {randomization_params: ...}`, as a task's YAML does, or that section's contents directly
    (`actor_params: ...`, `option: ...`). Other sections of a task's YAML are passed over.

    Raises:
        UserError: naming the file and the key.
    """
    raw = config.read_yaml(path)
    foreign.note(raw, str(path), more=_of_training(raw))
    section = (raw.get("task") or {}) if "task" in raw else raw
    section = section.get("randomization_params", section) if isinstance(section, dict) else section
    if not isinstance(section, dict) or not {"actor_params", "option"} & set(section):
        raise UserError(f"{path}: no parameters: expected task.randomization_params, or actor_params, with ranges")
    try:
        space = ParameterSpace.from_config(section, model)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    if not len(space):
        raise UserError(f"{path}: it names no parameter; leave --parameters out for damping, armature and mass")
    return space


# Whether MJX can simulate a model that somebody brings, what to change where it cannot, and what may be left out


AXIAL = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

# Of a joint's travel in the logs and of its range, the larger: as near as the motion has to come
# (docs/decisions/unreached_limits.md).
NEAR_TRAVEL, NEAR_RANGE = 0.25, 0.05


def one_line(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def check_simulable(model: mujoco.MjModel, source: str, lean: mujoco.MjModel | None = None) -> None:
    """Refuse a model without motion or commands, and what MJX cannot simulate; lean: what it is simulated as."""
    urdf.check_names(model, source)
    step = float(model.opt.timestep)
    if not (math.isfinite(step) and step > 0):
        raise UserError(f"{source}: <option timestep> = {step:g}; allowed: seconds > 0")
    if broken := _not_finite(model):
        raise UserError(f"{source}: numbers that are not finite in {', '.join(broken)}; allowed: finite numbers")
    if why := absent(model):
        raise UserError(f"{source}: MJX does not simulate {why}")
    idle = [label(model, "actuator", i) for i in range(model.nu) if not np.any(model.actuator_gear[i])]
    if len(idle) == model.nu:
        raise UserError(f"{source}: gear = 0 of every actuator ({', '.join(idle)}): the logged commands cannot act")
    if idle:
        warnings.warn(f"{source}: gear = 0 of {', '.join(idle)}: these commands do nothing", stacklevel=3)
    if model.opt.noslip_iterations:
        text = "MJX has no such iterations, so contacts and dry friction creep as they do without them"
        warnings.warn(f"{source}: noslip_iterations = {model.opt.noslip_iterations}: {text}", stacklevel=3)
    if model.nplugin:
        raise UserError(f"{source}: MJX cannot simulate this model: it has plugins")
    try:
        mjx.make_data(mjx.put_model(model if lean is None else lean, impl="jax"))
    except (NotImplementedError, ValueError, TypeError) as error:
        raise UserError(f"{source}: MJX cannot simulate this model: {one_line(error)}{_remedy(str(error))}") from None


def _not_finite(model: mujoco.MjModel) -> list[str]:
    """MuJoCo's arrays with a NaN or an infinity in them, by name: a gain, a mass, and what follows from them."""
    fields = ((name, getattr(model, name, None)) for name in dir(model) if not name.startswith("_"))
    floats = ((name, x) for name, x in fields if isinstance(x, np.ndarray) and x.dtype.kind == "f")
    return [name for name, x in floats if not np.isfinite(x).all()]


def _remedy(message: str) -> str:
    """Say what to change in the MJCF."""
    return next((f" ({remedy})" for word, remedy in _REMEDIES.items() if word in message), "")


_REMEDIES = {
    "mjtIntegrator": "use Euler, implicitfast or RK4 in <option integrator=...>",
    "mjtSolver": "use CG or Newton in <option solver=...>",
    "collisions": "switch the contacts of these geoms off by contype and conaffinity, or use other shapes",
    "margin/gap": "take margin and gap off these geoms",
    "Flex": "take the flexible bodies out",
    "mjtEnableBit": "take it out of <option><flag>",
    "mjGEOM": "use other shapes for these geoms",
    "fluid": "use the integrator Euler, or density and viscosity 0",
    "mjtSensor": "take these sensors out: a diagnosis reads joints",
    "ConeType.ELLIPTIC": "write condim 3, or cone pyramidal",
    "not supported": "MJX has motor, position, velocity and general actuators on joints, tendons and sites",
}


def label(model: mujoco.MjModel, kind: str, i: int) -> str:
    return getattr(model, kind)(i).name or f"{kind}{i}"


def contacts(physics: Physics) -> bool:
    """Whether anything can touch."""
    return bool(physics.template._impl.contact.dist.shape[0])


def unreached(model: mujoco.MjModel, logs: Sequence[Log]) -> tuple[int, ...]:
    """Joints with limits whose motion in the logs stays away from them; none that is not measured in all logs."""
    return tuple(j for j in range(model.njnt) if model.jnt_limited[j] and _away(model, j, logs))


def _away(model: mujoco.MjModel, j: int, logs: Sequence[Log]) -> bool:
    if model.jnt_type[j] not in AXIAL or not all(log.seen_dofs[model.jnt_dofadr[j]] for log in logs):
        return False
    q = np.concatenate([log.qpos[:, model.jnt_qposadr[j]] for log in logs])
    low, high = model.jnt_range[j]
    room = max(NEAR_TRAVEL * np.ptp(q), NEAR_RANGE * (high - low))
    return bool(low + room < q.min() and q.max() < high - room)
