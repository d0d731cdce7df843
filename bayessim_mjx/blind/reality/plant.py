"""Reality for a blind check: MuJoCo C at a fraction of the nominal step, wrong base parameters, causes, sensors.

Independent of the library's physics and effects.
"""

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.bodies import axis, chain, ground, length, turns
from bayessim_mjx.blind.reality.cause import Cause, Past, Scales

FINER = 10  # times, of the steps in reality, so that its own error of integration is small beside the nominal one
WIDTHS = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}  # of free, ball, slide and hinge joints in qpos and qvel
AXIAL = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))


class Rig(Protocol):
    """A robot without causes, and what an experimenter does with it in several runs.

    Attributes:
        name: of the robot; period: s, between two rows of a log; base: the body that stands on the ground, or "".
        sigma: rad or m by measured position, noise of the encoders.
        labels: operating condition of each run; pushed: runs by which a cause's strength is measured.
        tilts: whether a tilt of the ground makes sense; touching: geoms of the robot that touch others.
    """

    @property
    def name(self) -> str: ...
    @property
    def period(self) -> float: ...
    @property
    def sigma(self) -> Sequence[float]: ...
    @property
    def base(self) -> str: ...
    @property
    def tilts(self) -> bool: ...
    @property
    def touching(self) -> Sequence[str]: ...
    @property
    def labels(self) -> Sequence[str]: ...
    @property
    def pushed(self) -> Sequence[int]: ...

    def spec(self) -> mujoco.MjSpec:
        """Make the nominal model anew."""

    def record(self, plant: "Plant", index: int, seed: int, noise: bool = True) -> "Run":
        """Run `index` on a plant of this rig."""

    def repeat(self, plant: "Plant", run: "Run", row: int) -> None:
        """From a row of a run to the next, under the commands that acted there."""


@dataclasses.dataclass(frozen=True)
class Run:
    """time [T], ctrl [T, nu] in force from each row on, qpos, qvel [T, n] with and without noise, peak force by joint.

    pull: [T, nu] the actuators' mean force in the period before each row, zeros in the first. index: in its rig.
    """

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    clean: np.ndarray
    clean_v: np.ndarray
    effort: np.ndarray
    pull: np.ndarray | None = None
    index: int = 0


class Plant:
    """A compiled robot with causes.

    Attributes:
        model, data: MuJoCo's; timestep: s, a tenth of the nominal one or less, a divisor of the rig's period.
        joints: hinges and slides of the nominal model, in its order: where causes can sit.
    """

    def __init__(self, system: Rig, base: dict[str, float], causes: Sequence[Cause] = ()) -> None:
        spec = system.spec()
        names, kinds = [j.name for j in spec.joints], [int(j.type) for j in spec.joints]
        self.joints = [n for n, k in zip(names, kinds, strict=True) if k in AXIAL]
        scale_base(spec, base)
        for cause in causes:
            cause.edit(spec)
        self.steps = max(1, round(system.period / (spec.option.timestep / FINER)))
        spec.option.timestep /= FINER
        if abs(self.steps * spec.option.timestep - system.period) > 1e-9:
            self.steps = int(np.ceil(system.period / spec.option.timestep))
            spec.option.timestep = system.period / self.steps
        self.system, self.causes = system, tuple(causes)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.timestep = self.model.opt.timestep
        self.stepped = [c for c in causes if c.stepped]
        self._lay_out(names)
        self._gains = (self.model.actuator_gainprm.copy(), self.model.actuator_biasprm.copy())

    def _lay_out(self, names: Sequence[str]) -> None:
        """Where nominal joints and the play behind them lie in states of this model, and in what is measured."""
        model = self.model
        place = {model.joint(i).name: i for i in range(model.njnt)}
        q: list[int] = []
        v: list[int] = []
        play: list[tuple[int, int, int, int]] = []
        self._columns: dict[str, tuple[int, int]] = {}
        for name in names:
            i = place[name]
            width, speeds = WIDTHS[int(model.jnt_type[i])]
            self._columns[name] = (len(q), len(v))
            if (behind := place.get(f"{name}/play")) is not None:
                play.append((len(q), len(v), int(model.jnt_qposadr[behind]), int(model.jnt_dofadr[behind])))
            q += range(model.jnt_qposadr[i], model.jnt_qposadr[i] + width)
            v += range(model.jnt_dofadr[i], model.jnt_dofadr[i] + speeds)
        self._q, self._v, self._play = np.array(q, np.intp), np.array(v, np.intp), play

    def column(self, joint: str) -> int:
        return self._columns[joint][0]

    def speed_column(self, joint: str) -> int:
        return self._columns[joint][1]

    def address(self, joint: str) -> int:
        return int(self._q[self.column(joint)])

    def dof(self, joint: str) -> int:
        return int(self._v[self.speed_column(joint)])

    def dofs(self) -> np.ndarray:
        """Of `joints`, in `data.qvel`."""
        return np.array([self.dof(j) for j in self.joints], np.intp)

    def position(self, joint: str) -> float:
        return float(self.data.qpos[self.address(joint)])

    def link(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute true positions and velocities of the links, behind rotor and play."""
        q = self.data.qpos[self._q].copy()
        v = self.data.qvel[self._v].copy()
        for i, j, address, dof in self._play:
            q[i] += self.data.qpos[address]
            v[j] += self.data.qvel[dof]
        return q, v

    def reset(self, q: np.ndarray, v: np.ndarray, command: np.ndarray) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.model.actuator_gainprm[:], self.model.actuator_biasprm[:] = self._gains
        self.data.qpos[self._q], self.data.qvel[self._v] = q, v
        for cause in self.causes:
            cause.reset(self, command)
        self._seen(q.copy(), v.copy())
        mujoco.mj_forward(self.model, self.data)

    def resume(self, run: Run, row: int) -> None:
        """After `reset` at a row of a run: what its causes would remember there."""
        upto = slice(0, row + 1)
        past = Past(run.time[upto] - run.time[0], run.clean[upto], run.clean_v[upto], run.ctrl[upto])
        for cause in self.causes:
            cause.resume(self, past)

    def advance(self, command: np.ndarray, steps: int | None = None) -> None:
        """One period (or so many of its steps) under a held command."""
        count = self.steps if steps is None else steps
        if not self.stepped:
            self.data.ctrl[:] = command
            self.move(count)
            return
        for _ in range(count):
            u = command.copy()
            self.data.qfrc_applied[:] = 0
            self.data.xfrc_applied[:] = 0
            for cause in self.stepped:
                cause.command(self, u)
                cause.force(self)
            self.data.ctrl[:] = u
            self.move(1)
            self._seen(*self.link())

    def _seen(self, q: np.ndarray, v: np.ndarray) -> None:
        """Sensors that remember see what those before them show: two at one joint both act."""
        for cause in self.causes:
            cause.watch(self, q, v)
            cause.sense(self, q, v)

    def move(self, count: int) -> None:
        """So many steps under the commands and forces that are in `data`."""
        mujoco.mj_step(self.model, self.data, count)

    def measure(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the readings of encoders without noise."""
        q, v = self.link()
        for cause in self.causes:
            cause.sense(self, q, v)
        return q, v

    def force(self) -> np.ndarray:
        """Return the larger of the driving and the loading force of each of `joints` now, N m or N."""
        d = self.data
        return np.maximum(np.abs(d.qfrc_actuator), np.abs(d.qfrc_bias))[self.dofs()]


def scale_base(spec: mujoco.MjSpec, base: dict[str, float]) -> None:
    """Multiply `<body>.mass`, `<joint>.damping`, `<joint>.armature`; inertia goes with mass."""
    for name, factor in base.items():
        place, attribute = name.rsplit(".", 1)
        if attribute == "mass":
            _scale_mass(spec.body(place), factor)
        elif attribute == "damping":
            spec.joint(place).damping[0] *= factor
        else:
            spec.joint(place).armature *= factor


def _scale_mass(body: mujoco.MjsBody, factor: float) -> None:
    """Of what is stated and of the geoms: the compiler takes one of both, by its `inertiafromgeom` too."""
    for attribute in ("mass", "inertia", "fullinertia"):  # the last is NaN where it is not used
        setattr(body, attribute, getattr(body, attribute) * factor)
    for geom in body.geoms:
        attribute = "density" if np.isnan(geom.mass) else "mass"
        setattr(geom, attribute, getattr(geom, attribute) * factor)


def base_names(model: mujoco.MjModel) -> list[str]:
    """`<body>.mass`, `<joint>.damping` and `<joint>.armature` wherever the model has some that can move."""
    joints = [i for i in range(model.njnt) if int(model.jnt_type[i]) != int(mujoco.mjtJoint.mjJNT_FREE)]
    names = [
        f"{model.body(i).name}.mass" for i in range(model.nbody) if model.body_weldid[i] and model.body_mass[i] > 0
    ]
    for attribute in ("damping", "armature"):
        values = getattr(model, f"dof_{attribute}")
        names += [f"{model.joint(i).name}.{attribute}" for i in joints if values[model.jnt_dofadr[i]] > 0]
    return names


def base_parameters(system: Rig, spread: float, rng: np.random.Generator) -> dict[str, float]:
    """Factors of the base parameters, uniform within 1 +- spread."""
    return {n: float(rng.uniform(1 - spread, 1 + spread)) for n in base_names(system.spec().compile())}


def scales_of(plant: Plant, runs: Sequence[Run]) -> Scales:
    """Sizes of things in runs without causes."""
    model = plant.model
    q, v = (np.concatenate([getattr(r, k) for r in runs]) for k in ("clean", "clean_v"))
    u = np.concatenate([r.ctrl for r in runs])
    jump = np.concatenate([np.abs(np.diff(r.ctrl, axis=0)) for r in runs]) / plant.system.period
    force = dict(zip(plant.joints, np.max([r.effort for r in runs], axis=0).tolist(), strict=True))
    actuators = [model.actuator(i).name for i in range(model.nu)]
    drives = {
        a: model.joint(model.actuator_trnid[i, 0]).name
        for i, a in enumerate(actuators)
        if int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINT)
    }
    drives = {a: j for a, j in drives.items() if j in plant.joints}
    gear = dict(zip(actuators, np.abs(model.actuator_gear[:, 0]).tolist(), strict=True))
    bodies = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
    positions, speeds = model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2]
    led = (positions != 0) | ((speeds != 0) & (speeds == -model.actuator_gainprm[:, 0]))
    turned = [i for i in bodies if turns(model, i)]
    return Scales(
        force=force,
        speed={j: float(np.abs(v[:, plant.speed_column(j)]).max()) for j in plant.joints},
        travel={j: (float(q[:, plant.column(j)].min()), float(q[:, plant.column(j)].max())) for j in plant.joints},
        inertia={j: float(1 / model.dof_invweight0[plant.dof(j)]) for j in plant.joints},
        command=dict(zip(actuators, np.abs(u).max(0).tolist(), strict=True)),
        rate=dict(zip(actuators, np.quantile(jump, 0.99, axis=0).tolist(), strict=True)),
        mass={model.body(i).name: float(model.body_mass[i]) for i in bodies},
        drives=drives,
        timestep=plant.timestep,
        servo=frozenset(a for i, a in enumerate(actuators) if model.actuator_biasprm[i, 1] != 0),
        effort={a: force[j] / max(gear[a], 1e-12) for a, j in drives.items()},
        base=plant.system.base,
        ends=_ends(model),
        rotors=tuple(j for j in drives.values() if model.body_jntnum[model.jnt_bodyid[model.joint(j).id]] == 1),
        direct=frozenset(a for i, a in enumerate(actuators) if model.actuator_dyntype[i] == 0),
        led=frozenset(a for i, a in enumerate(actuators) if led[i]),
        length={model.body(i).name: length(model, i) for i in turned},
        axis={model.body(i).name: axis(model, i) for i in turned},
        ground=bool(ground(plant.system.spec())),
        floats=tuple(model.body(int(model.jnt_bodyid[j])).name for j in np.flatnonzero(model.jnt_type == 0)),
        chain=chain(model, plant.joints),
    )


def _ends(model: mujoco.MjModel) -> tuple[str, ...]:
    """List moving bodies that carry no other, and the moving ones before them."""
    moving = [i for i in range(model.nbody) if model.body_weldid[i] != 0 and model.body_weldid[i] == i]
    leaves = [i for i in moving if i not in {int(model.body_parentid[k]) for k in moving}]
    found = {*leaves, *(int(model.body_parentid[i]) for i in leaves)}
    return tuple(model.body(i).name for i in moving if i in found)
