"""The user's robot and logs as a rig of the finer reality; without logs, motions within the model's limits."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx import urdf
from bayessim_mjx.blind.reality.plant import AXIAL, Plant, Rig
from bayessim_mjx.blind.reality.replay import Replay, Take, geoms_in_touch, strays
from bayessim_mjx.blind.reality.system import System
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log, read_logs
from bayessim_mjx.logs.signals import quantum

# stand-ins where there are no logs to take them from: choices, by no measurement
SIGMA = 4e-4  # rad or m, encoder noise where no log shows one: a step of 14 bits in a turn
PERIOD = 0.01  # s, of logs where there are none
LEAST = 1e-5  # of a joint's range of motion: no encoder is finer
SWING, REACH = 0.35, 0.7  # share of a joint's range that the menu moves through; rad, where it has none
OWN = ("repeat_of", "source")  # metadata that name files
Load = Callable[[], mujoco.MjSpec]


def load_model(path: Path, drive: str | None = None, packages: Sequence[str] = ()) -> mujoco.MjSpec:
    """Load a file as a specification whose elements all have names, without keyframes of another size.

    Args:
        drive, packages: see `urdf`.

    Raises:
        UserError: there is no such file, or MuJoCo cannot load it.
    """
    spec = urdf.load(path, drive, packages)
    try:
        return _named(spec)
    except ValueError as error:
        raise UserError(f"--model {path}: MuJoCo cannot load it: {error}") from None


def load_task(name: str) -> Load:
    """Load the model of one of our tasks, anew with every call.

    Raises:
        UserError: no such task, or it has no MuJoCo model of ours.
    """
    from bayessim_mjx import registry
    from bayessim_mjx.cli import task_name
    from bayessim_mjx.config import load

    full = task_name(name)
    env: Any = registry.make(full, config=load(full))
    if not hasattr(env, "spec"):
        raise UserError(f"--task {name}: it has no MuJoCo model of ours; give its MJCF with --model")
    return lambda: _named(env.spec())


def _named(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """As logs call what has no name: joint0, actuator0, and bodies body0."""
    for key in list(spec.keys):  # their size is that of a model without causes
        spec.delete(key)
    spec.compile()
    for kind, elements in (("joint", spec.joints), ("actuator", spec.actuators), ("body", spec.bodies)):
        for element in elements:
            element.name = element.name or f"{kind}{element.id}"
    return spec


def rig_of_logs(load: Load, paths: Sequence[str], name: str, log_map: str | None = None) -> tuple[Replay, list[Log]]:
    """Make a rig that repeats logs, and return it with the logs.

    Raises:
        UserError: what is wrong with a log; logs whose commands go through a controller of the log's own, or with
            drives that were switched off: the finer reality has neither.
    """
    model = load().compile()
    logs = [log for log in read_logs(list(paths), model, map=log_map) if _can_be_repeated(log)]
    if not logs:
        raise UserError(f"--data {' '.join(paths)}: no log can be repeated: in all of them drives are switched off")
    sigma, speed = (np.median([getattr(log, k) for log in logs], axis=0) for k in ("sigma_qpos", "sigma_qvel"))
    steps = np.median([[quantum(x) for x in log.qpos.T] for log in logs], axis=0)
    span = np.ptp(np.concatenate([log.qpos for log in logs]), axis=0)
    period = float(np.median([log.period for log in logs]))
    period = round(period / 1e-5) * 1e-5 if period > 1e-3 else period
    takes = tuple(_take(log) for log in logs)
    sigma = np.maximum(sigma, LEAST * np.maximum(span, 1e-9))
    noise = (tuple(sigma.tolist()), tuple(speed.tolist()), tuple(steps.tolist()))
    rig = Replay(name, load, period, takes, *noise, _base(model), _stands(model))
    plain = Plant(rig, {})
    led = [dataclasses.replace(t, led=strays(plain, rig, i)) for i, t in enumerate(takes)]
    return dataclasses.replace(rig, takes=tuple(led), touching=geoms_in_touch(plain, rig)), logs


def _can_be_repeated(log: Log) -> bool:
    law = (log.metadata.get("controller") or {}).get("law", "torque")
    if law in ("position", "pd", "p", "velocity"):
        raise UserError(f"log {log.name}: its controller ({law}) stands in the metadata; allowed: one in the model")
    return bool(log.enabled.all())


def _take(log: Log) -> Take:
    metadata = {k: v for k, v in log.metadata.items() if k not in OWN}
    metadata.setdefault("condition", log.name)
    late = max(log.late, 0.0)  # commands that act early would have to be known before they are sent
    if "commands_late" in metadata:
        metadata["commands_late"] = late
    stem = Path(log.name.replace("#", "_")).stem
    return Take(stem, metadata, log.time, log.ctrl, log.qpos, log.qvel, False, late, log.linear)


def _base(model: mujoco.MjModel) -> str:
    """Name the body that stands on the ground and carries moving ones, "" where the world itself does."""
    moving = [i for i in range(1, model.nbody) if model.body_weldid[i] == i and model.body_weldid[i] != 0]
    under = [int(model.body_parentid[i]) for i in moving if int(model.body_weldid[model.body_parentid[i]]) == 0]
    names = [model.body(i).name for i in under if i != 0]
    return names[0] if names else ""


def _stands(model: mujoco.MjModel) -> bool:
    """Tell whether the robot has no free base and feels a tilt of the ground through gravity."""
    floats = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any()
    return bool(not floats and np.linalg.norm(model.opt.gravity) > 0)


def rig_of_menu(load: Load, name: str) -> System:
    """Make a rig that moves in triangles, multisines, chirps and steps within the model's ranges.

    Raises:
        UserError: a robot whose motion cannot be proposed: it floats, mixes servos with torques, or a drive has no
            limits or no joint.
    """
    model = load().compile()
    ways = "give logs with --data"
    if not (np.isin(model.jnt_type, AXIAL).all() and model.nu and (model.actuator_trntype == 0).all()):
        raise UserError(f"{name}: motions are proposed for robots of driven hinges and slides alone; {ways}")
    servo = model.actuator_biasprm[:, 1] != 0
    if servo.any() != servo.all():
        raise UserError(f"{name}: some drives take positions and some take torques; {ways}")
    if not servo.any() and not model.actuator_ctrllimited.all():
        free = [model.actuator(i).name for i in range(model.nu) if not model.actuator_ctrllimited[i]]
        raise UserError(f"{name}: {', '.join(free)} without ctrlrange; state it in the model, or {ways}")
    driven = model.actuator_trnid[:, 0]
    ranges, limited = model.jnt_range[driven], model.jnt_limited[driven].astype(bool)
    centre = np.where(limited, ranges.mean(1), model.qpos0[model.jnt_qposadr[driven]])
    swing = np.where(limited, SWING * np.ptp(ranges, axis=1), REACH)
    pull = np.abs(model.actuator_gainprm[:, 0] * model.actuator_gear[:, 0])
    inertia = 1 / model.dof_invweight0[model.jnt_dofadr[driven]]
    kp, kd = (inertia * x / np.maximum(pull, 1e-12) for x in ((2 * np.pi * 2.5) ** 2, 1.4 * 2 * np.pi * 2.5))
    period = max(1, round(PERIOD / model.opt.timestep)) * model.opt.timestep
    return System(
        name, "", period, bool(servo.all()), tuple(kp), tuple(kd), tuple(centre), tuple(swing), 0.5,
        (SIGMA,) * model.njnt, base=_base(model), tilts=_stands(model), load=load,
    )  # fmt: skip


def short(rig: Rig) -> Rig:
    """Shorten the rig to the first seconds of long logs, by which strengths are measured."""
    return rig.shortened() if isinstance(rig, Replay) else rig


@dataclasses.dataclass(frozen=True)
class Motion(System):
    """One motion of the menu alone."""

    only: int = 0

    @property
    def pushed(self) -> tuple[int, ...]:
        return (self.only,)


def motions(load: Load, name: str, sigma: tuple[float, ...]) -> dict[str, Motion]:
    """{name: rig} of every kind of motion in the menu; sigma: noise of the encoders.

    Raises:
        UserError: see `rig_of_menu`.
    """
    menu = rig_of_menu(load, name)
    own = {f.name: getattr(menu, f.name) for f in dataclasses.fields(menu)} | {"sigma": sigma}
    first = {label: i for i, label in reversed(list(enumerate(menu.labels)))}
    return {label.replace("_", " "): Motion(**own, only=i) for label, i in sorted(first.items(), key=lambda x: x[1])}
