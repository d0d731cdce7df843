"""Cheap simulated logs with known truth for the look before any simulation: MuJoCo C alone, nothing is compiled.

Independent of the library's physics and effects; data-sheet values are off by 5 %, as data sheets are.
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np
from systems import SYSTEMS

from bayessim_mjx.blind.reality.system import RUNS, System, reference
from bayessim_mjx.logs import Channels, Log, estimate_velocity

SETTLE = 1.0  # s at rest before a log begins
FINEST = 0.0005  # s, longest simulated step


@dataclasses.dataclass(frozen=True)
class Truth:
    """What is wrong with a rig.

    Attributes:
        effect, where: of the library; "" where nothing is wrong but data-sheet values.
        values: its parameters.
    """

    effect: str = ""
    where: str = ""
    values: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class Rig:
    """How a rig is logged: s between rows; noise and steps of encoders in rad or m; effort: logged, noise of it."""

    system: str
    truth: Truth
    period: float
    sigma: float
    quantum: float
    effort: bool
    effort_noise: float = 0.01
    seed: int = 0
    spread: float = 0.05
    runs: int = 6
    seconds: float = 4.0


def scales(system: System) -> dict[str, np.ndarray]:
    """Efforts `[nu]` N m or N that the nominal model needs about its usual posture."""
    model = mujoco.MjModel.from_xml_string(system.xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    drives = _drives(model)
    pace = 2 * np.pi * system.pace
    found = []
    for _ in range(60):
        data.qpos[drives] = np.asarray(system.centre) + np.asarray(system.swing) * rng.uniform(-1, 1, model.nu)
        data.qvel[drives] = 0.7 * np.asarray(system.swing) * pace * rng.normal(size=model.nu)
        data.qacc[drives] = 0.7 * np.asarray(system.swing) * pace**2 * rng.normal(size=model.nu)
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse[drives].copy())
    speed = 0.7 * np.asarray(system.swing) * pace
    return {"effort": np.sqrt(np.mean(np.square(found), 0)), "speed": speed}


def _drives(model: mujoco.MjModel) -> list[int]:
    return [int(model.jnt_dofadr[model.actuator_trnid[i, 0]]) for i in range(model.nu)]


def draw(system: str, effect: str, rng: np.random.Generator) -> Truth:
    """An effect of 5 to 40 % of the effort at a place drawn at random."""
    rig = SYSTEMS[system]
    model, size = mujoco.MjModel.from_xml_string(rig.xml), scales(rig)
    i = int(rng.integers(model.nu))
    name, joint = model.actuator(i).name, model.joint(int(model.actuator_trnid[i, 0])).name
    share = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4))))
    effort, speed = float(size["effort"][i]), float(size["speed"][i])
    if effect == "payload":
        bodies = [b for b in range(1, model.nbody) if model.body_weldid[b] == b]
        body = int(rng.choice(bodies[1:] if len(bodies) > 3 else bodies))  # on a column that turns it does not show
        mass = float(model.body_subtreemass[body]) * float(rng.uniform(0.15, 0.8))
        return Truth(effect, model.body(body).name, (mass, *(rng.uniform(-0.05, 0.05, 3))))
    if effect == "actuator_gain":
        return Truth(effect, name, (float(rng.choice([1 - share, 1 + share])),))
    if effect in ("servo_stiffness", "servo_damping"):  # a firmware's gains have no known relation to the model's
        return Truth(effect, name, (float(np.exp(rng.choice([-1, 1]) * rng.uniform(np.log(1.3), np.log(3.0)))),))
    if effect == "gain_everywhere":
        return Truth("actuator_gain", "all", (float(rng.choice([1 - share, 1 + share])),))
    if effect == "friction_everywhere":
        return Truth("coulomb_friction", "all", (share * float(size["effort"].min()),))
    if effect == "friction_in_each":  # of another size in every joint
        own = np.exp(rng.uniform(np.log(0.1), np.log(0.4), model.nu)) * size["effort"]
        return Truth("coulomb_friction", "each", tuple(map(float, own)))
    if effect == "actuator_bias":
        return Truth(effect, name, (float(rng.choice([-1, 1])) * share * effort,))
    if effect == "viscous_friction":
        return Truth(effect, joint, (share * effort / speed,))
    if effect == "actuator_saturation":
        return Truth(effect, name, ((1 - share) * 1.6 * effort,))
    return Truth(effect, joint, (share * effort,)) if effect else Truth()


def _built(rig: Rig, rng: np.random.Generator) -> mujoco.MjModel:
    system, truth = SYSTEMS[rig.system], rig.truth
    spec, nominal = mujoco.MjSpec.from_string(system.xml), mujoco.MjModel.from_xml_string(system.xml)
    off = lambda: float(np.clip(1 + rig.spread * rng.normal(), 0.8, 1.2))  # noqa: E731
    for body in spec.bodies[1:]:
        factor = off()
        for geom in body.geoms:
            geom.mass *= factor
    driven = [nominal.joint(int(i)).name for i in nominal.actuator_trnid[:, 0]]
    for joint in spec.joints:
        joint.armature *= off()
        if truth.where == "each" and joint.name in driven:
            joint.frictionloss = truth.values[driven.index(joint.name)]
        joint.damping[0] *= off()
        if truth.where in (joint.name, "all") and truth.effect == "coulomb_friction":
            joint.frictionloss = truth.values[0]
        if truth.where == joint.name and truth.effect == "viscous_friction":
            joint.damping[0] += truth.values[0]
    if truth.effect == "payload":
        load = spec.body(truth.where).add_body(name="load")
        load.pos = nominal.body(truth.where).ipos + np.array(truth.values[1:])
        load.mass, load.inertia, load.ipos, load.explicitinertial = truth.values[0], np.full(3, 1e-9), np.zeros(3), True
    steps = int(np.ceil(rig.period / FINEST))
    spec.option.timestep = rig.period / steps
    model = spec.compile()
    for i in range(model.nu):
        on = truth.where in (model.actuator(i).name, "all")
        if on and truth.effect == "actuator_gain":
            model.actuator_gainprm[i] *= truth.values[0]
            model.actuator_biasprm[i] *= truth.values[0]
        if on and truth.effect == "servo_stiffness":
            model.actuator_gainprm[i, 0] *= truth.values[0]
            model.actuator_biasprm[i, 1] *= truth.values[0]
        if on and truth.effect == "servo_damping":
            model.actuator_biasprm[i, 2] *= truth.values[0]
        if on and truth.effect == "actuator_bias":
            model.actuator_biastype[i] = int(mujoco.mjtBias.mjBIAS_AFFINE)
            model.actuator_biasprm[i, 0] += truth.values[0]
        if on and truth.effect == "actuator_saturation":
            model.actuator_forcelimited[i], model.actuator_forcerange[i] = 1, np.array([-1, 1]) * truth.values[0]
    return model


def record(rig: Rig) -> tuple[mujoco.MjModel, list[Log]]:
    """(the nominal model, logs of a rig)."""
    system, rng = SYSTEMS[rig.system], np.random.default_rng(rig.seed)
    model = _built(rig, rng)
    nominal = mujoco.MjModel.from_xml_string(system.xml)
    return nominal, [_run(rig, system, model, nominal, k, rng) for k in range(rig.runs)]


def _run(rig: Rig, system: System, model: mujoco.MjModel, nominal: Any, k: int, rng: np.random.Generator) -> Log:
    condition, profile, size, pace = RUNS[k % (len(RUNS) - 1)]  # closed loops alone
    target = reference(
        profile, size * np.asarray(system.swing), pace * system.pace, np.random.default_rng((rig.seed, k))
    )
    data, drives, centre = mujoco.MjData(model), _drives(model), np.asarray(system.centre)
    limit = np.full(model.nu, np.inf) if system.servo else nominal.actuator_ctrlrange[:, 1]
    steps = round(rig.period / model.opt.timestep)
    data.qpos[drives] = centre + target(0.0)
    rows: dict[str, list[np.ndarray]] = {n: [] for n in ("time", "ctrl", "qpos", "effort")}
    effort = np.zeros(model.nu)
    for row in range(-round(SETTLE / rig.period), round(rig.seconds / rig.period) + 1):
        t = max(row * rig.period, 0.0)
        seen = data.qpos + rig.sigma * rng.normal(size=model.nv)
        seen = rig.quantum * np.round(seen / rig.quantum) if rig.quantum else seen
        ctrl = centre + target(t)
        if not system.servo:
            rate = (target(t + 5e-3) - target(t - 5e-3)) / 1e-2 if row > 0 else 0.0
            speed = data.qvel[drives]  # the drive's own, finer than the log's
            ctrl = np.asarray(system.kp) * (ctrl - seen[drives]) + np.asarray(system.kd) * (rate - speed)
            ctrl = np.clip(ctrl, -limit, limit)
        if row >= 0:
            for name, value in zip(rows, (np.array(t), ctrl, seen, effort), strict=True):
                rows[name].append(np.array(value))
        data.ctrl[:], effort = ctrl, np.zeros(model.nu)
        for _ in range(steps):
            mujoco.mj_step(model, data)
            effort = effort + data.actuator_force / steps
    time, ctrl, qpos, measured = (np.array(rows[n]) for n in rows)
    names = Channels.of(nominal)
    sigma = np.full(model.nv, max(rig.sigma, rig.quantum / np.sqrt(12), 1e-7))
    qvel, spread = estimate_velocity(time, qpos, names, sigma)
    noise = rig.effort_noise * np.sqrt(np.mean(measured**2, 0)) * rng.normal(size=measured.shape)
    streams = {f"effort:{a}": measured[:, i] + noise[:, i] for i, a in enumerate(names.actuators)} if rig.effort else {}
    return Log(
        f"{k}_{condition}", time, ctrl, qpos, qvel, False, names, sigma, spread, streams, {"condition": condition}
    )
