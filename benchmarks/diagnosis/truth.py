"""Reality for the diagnosis benchmark: MuJoCo C at a tenth of the nominal step, wrong base parameters, causes, sensors.

Independent of the library's physics and effects. `Plant` is a robot with its causes, `run` moves it as an experimenter
would.
"""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from causes import Cause, Scales
from systems import RUNS, SECONDS, System, reference

FINER = 10
QUANTUM = 2 * np.pi / 16384


@dataclasses.dataclass(frozen=True)
class Run:
    """time [T], ctrl [T, nu] in force from each row on, qpos, qvel [T, joints] with and without noise, peak effort."""

    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    clean: np.ndarray
    clean_v: np.ndarray
    effort: np.ndarray


class Plant:
    """A compiled robot with causes.

    Attributes:
        model, data: MuJoCo's; timestep: s, a tenth of the nominal one.
        joints: names in the nominal order, the columns of everything recorded.
    """

    def __init__(self, system: System, base: dict[str, float], causes: Sequence[Cause] = ()) -> None:
        spec = mujoco.MjSpec.from_string(system.xml)
        self.joints = [j.name for j in spec.joints]
        scale_base(spec, base)
        for cause in causes:
            cause.edit(spec)
        spec.option.timestep /= FINER
        self.system, self.causes = system, tuple(causes)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.timestep = self.model.opt.timestep
        self.steps = round(system.period / self.timestep)
        self.stepped = [c for c in causes if c.stepped]
        names = [self.model.joint(i).name for i in range(self.model.njnt)]
        self._rotor = np.array([names.index(j) for j in self.joints])
        self._play = [(i, names.index(f"{j}/play")) for i, j in enumerate(self.joints) if f"{j}/play" in names]
        self._gains = (self.model.actuator_gainprm.copy(), self.model.actuator_biasprm.copy())

    def column(self, joint: str) -> int:
        return self.joints.index(joint)

    def address(self, joint: str) -> int:
        return int(self.model.jnt_qposadr[self._rotor[self.column(joint)]])

    def dof(self, joint: str) -> int:
        return int(self.model.jnt_dofadr[self._rotor[self.column(joint)]])

    def position(self, joint: str) -> float:
        return float(self.data.qpos[self.address(joint)])

    def link(self) -> tuple[np.ndarray, np.ndarray]:
        """True positions and velocities of the links, behind rotor and play."""
        q = self.data.qpos[self._rotor].copy()
        v = self.data.qvel[self._rotor].copy()
        for i, j in self._play:
            q[i] += self.data.qpos[j]
            v[i] += self.data.qvel[j]
        return q, v

    def reset(self, q: np.ndarray, v: np.ndarray, command: np.ndarray) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.model.actuator_gainprm[:], self.model.actuator_biasprm[:] = self._gains
        self.data.qpos[self._rotor], self.data.qvel[self._rotor] = q, v
        for cause in self.causes:
            cause.reset(self, command)
            cause.watch(self, q, v)
        mujoco.mj_forward(self.model, self.data)

    def advance(self, command: np.ndarray) -> None:
        """One period under a held command."""
        if not self.stepped:
            self.data.ctrl[:] = command
            mujoco.mj_step(self.model, self.data, self.steps)
            return
        for _ in range(self.steps):
            u = command.copy()
            self.data.qfrc_applied[:] = 0
            self.data.xfrc_applied[:] = 0
            for cause in self.stepped:
                cause.command(self, u)
                cause.force(self)
            self.data.ctrl[:] = u
            mujoco.mj_step(self.model, self.data)
            seen = self.link()
            for cause in self.stepped:
                cause.watch(self, *seen)

    def measure(self) -> tuple[np.ndarray, np.ndarray]:
        """What encoders without noise show."""
        q, v = self.link()
        for cause in self.causes:
            cause.sense(self, q, v)
        return q, v


def scale_base(spec: mujoco.MjSpec, base: dict[str, float]) -> None:
    """Multiply `<body>.mass`, `<joint>.damping`, `<joint>.armature`; inertia goes with mass."""
    for name, factor in base.items():
        place, attribute = name.rsplit(".", 1)
        if attribute == "mass":
            for geom in spec.body(place).geoms:
                geom.mass *= factor
        elif attribute == "damping":
            spec.joint(place).damping[0] *= factor
        else:
            spec.joint(place).armature *= factor


def base_parameters(system: System, spread: float, rng: np.random.Generator) -> dict[str, float]:
    """Factors of the base parameters, uniform within 1 +- spread."""
    model = mujoco.MjModel.from_xml_string(system.xml)
    names = [f"{model.body(i).name}.mass" for i in range(model.nbody) if model.body_weldid[i] != 0]
    names += [f"{model.joint(i).name}.{a}" for a in ("damping", "armature") for i in range(model.njnt)]
    return {n: float(rng.uniform(1 - spread, 1 + spread)) for n in names}


def run(plant: Plant, index: int, seed: int, noise: bool = True) -> Run:
    """Run `index` of RUNS: the outer controller sees noisy encoders, as the log does."""
    system, model = plant.system, plant.model
    rng = np.random.default_rng((seed, index))  # noise; the motion is that of the system and the run
    _, profile, size, pace = RUNS[index]
    plan = np.random.default_rng((seed, index, 1))
    target = reference(profile, size * np.asarray(system.swing), pace * system.pace, plan)
    extra = reference("multisine", np.ones(model.nu), 1.3 * system.pace, plan)
    free = RUNS[index][0] == "open_loop" and not system.servo
    driven = [plant.column(model.joint(i).name) for i in model.actuator_trnid[:, 0]]
    limit = model.actuator_ctrlrange[:, 1] if not system.servo else np.full(model.nu, np.inf)
    centre = np.asarray(system.centre)
    sigma, rows = np.asarray(system.sigma), round(SECONDS / system.period) + 1
    quantum = QUANTUM * (rng.uniform() < 0.5)

    def control(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if system.servo:
            return centre + target(t)
        goal = centre + (0 if free else target(t))
        rate = 0 if free else (target(t + 5e-3) - target(t - 5e-3)) / 1e-2
        soft = (0.0 if len(plant.joints) < 3 and model.nu == 1 else 0.2) if free else 1.0
        u = soft * (np.asarray(system.kp) * (goal - q[driven]) + np.asarray(system.kd) * (rate - v[driven]))
        return np.clip(u + (system.push * limit * extra(t) if free else 0), -limit, limit)

    start, speed = np.zeros((2, len(plant.joints)))
    start[driven] = centre + system.lift + (0 if free else target(0.0))
    speed[driven] = 0 if free else (target(5e-3) - target(-5e-3)) / 1e-2
    plant.reset(start, speed, control(0.0, start, speed))
    record: dict[str, list[np.ndarray]] = {k: [] for k in ("ctrl", "qpos", "qvel", "clean", "clean_v")}
    effort = np.zeros(len(plant.joints))
    for row in range(rows):
        clean, clean_v = plant.measure()
        q = clean + noise * sigma * rng.normal(size=len(sigma))
        v = clean_v + noise * 20 * sigma * rng.normal(size=len(sigma))
        if noise and quantum:
            q = quantum * np.round(q / quantum)
        u = control(row * system.period, q, v)
        for key, value in zip(record, (u, q, v, clean, clean_v), strict=True):
            record[key].append(value)
        plant.advance(u)
        data = plant.data
        effort = np.maximum(effort, np.maximum(np.abs(data.qfrc_actuator), np.abs(data.qfrc_bias))[plant._rotor])
    stacked = {k: np.array(v) for k, v in record.items()}
    return Run(time=np.arange(rows) * system.period, **stacked, effort=effort)


def scales_of(plant: Plant, runs: Sequence[Run]) -> Scales:
    """Sizes of things in runs without causes."""
    model = plant.model
    q, v = (np.concatenate([getattr(r, k) for r in runs]) for k in ("clean", "clean_v"))
    u = np.concatenate([r.ctrl for r in runs])
    jump = np.concatenate([np.abs(np.diff(r.ctrl, axis=0)) for r in runs]) / plant.system.period
    effort = np.max([r.effort for r in runs], axis=0)
    actuators = [model.actuator(i).name for i in range(model.nu)]
    bodies = [i for i in range(model.nbody) if model.body_weldid[i] != 0]
    return Scales(
        force=dict(zip(plant.joints, effort.tolist(), strict=True)),
        speed=dict(zip(plant.joints, np.abs(v).max(0).tolist(), strict=True)),
        travel={j: (float(q[:, i].min()), float(q[:, i].max())) for i, j in enumerate(plant.joints)},
        inertia=dict(zip(plant.joints, (1 / model.dof_invweight0).tolist(), strict=True)),
        command=dict(zip(actuators, np.abs(u).max(0).tolist(), strict=True)),
        rate=dict(zip(actuators, np.quantile(jump, 0.99, axis=0).tolist(), strict=True)),
        mass={model.body(i).name: float(model.body_mass[i]) for i in bodies},
        drives={a: model.joint(model.actuator_trnid[i, 0]).name for i, a in enumerate(actuators)},
        timestep=plant.timestep,
        servo=plant.system.servo,
    )
