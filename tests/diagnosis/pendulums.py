"""Logs of a pendulum from MuJoCo C at a tenth of the diagnosed simulator's step, for the tests of the diagnosis.

Integrated by Runge-Kutta: MuJoCo's Euler step would act half a sub-step early, which precise logs show as a gap.
"""

import copy
import dataclasses
from pathlib import Path

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.fitting import robot, windows
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.logs import Channels, Log, estimate_velocity, write_log

MODEL = """<mujoco><option timestep="%g" integrator="%s"/><worldbody><body name="link">
  <joint name="hinge" axis="0 1 0" damping="%g" armature="%g" frictionloss="%g"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="%g" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
STEP, PERIOD = 0.002, 0.02  # s, of the simulator and of the logs
DAMPING, ARMATURE, MASS = 0.02, 0.005, 0.5  # nominal
NAMES = ("hinge_damping_mult", "hinge_armature_mult", "link_mass_mult")
FEW = ("coulomb_friction", "viscous_friction", "actuator_delay", "actuator_gain", "payload")


def nominal(folder: Path) -> robot.Robot:
    """The simulator under diagnosis."""
    path = folder / "pendulum.xml"
    path.write_text(MODEL % (STEP, "Euler", DAMPING, ARMATURE, 0.0, MASS))
    return robot.of_file(path)


def recorded(
    *,
    friction: float = 0.0,
    delay: float = 0.0,
    cubic: float = 0.0,
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    count: int = 8,
    seconds: float = 4.0,
    sigma: float = 4e-4,
    seed: int = 0,
    late_velocity: float | None = None,
    **metadata: object,
) -> list[Log]:
    """`count` logs under a PD law that follows sines, slow to fast.

    Args:
        friction: N m; delay: s; cubic: N m/rad^3, of a spring that is relaxed at 0.
        scale: of damping, armature and mass; sigma: rad.
        late_velocity: s, by which velocities are measured late, to 4 sigma a second; None: they are not measured.
    """
    each = 10 * round(PERIOD / STEP)
    damping, armature, mass = np.multiply((DAMPING, ARMATURE, MASS), scale)
    model = mujoco.MjModel.from_xml_string(MODEL % (PERIOD / each, "RK4", damping, armature, friction, mass))
    rng = np.random.default_rng(seed)
    more = (delay, cubic, sigma, rng, late_velocity, metadata)
    return [_one(model, i, round(seconds / PERIOD), each, *more) for i in range(count)]


def _one(
    model: mujoco.MjModel,
    i: int,
    rows: int,
    each: int,
    delay: float,
    cubic: float,
    sigma: float,
    rng: np.random.Generator,
    late_velocity: float | None,
    metadata: dict[str, object],
) -> Log:
    data, late = mujoco.MjData(model), round(delay / model.opt.timestep)
    data.qpos[0] = 0.3 * rng.normal()
    rate, size = 0.4 + 0.2 * i, 0.3 + 0.1 * i
    table, held, speeds = [], [], [0.0]
    for k in range(rows + 1):
        t = k * PERIOD
        target = size * np.sin(2 * np.pi * rate * t + i) + 0.2 * np.sin(3.1 * rate * t)
        command = 6.0 * (target - data.qpos[0]) - 0.6 * data.qvel[0]
        behind = round((late_velocity or 0.0) / model.opt.timestep)
        table.append((t, command, data.qpos[0], speeds[max(0, len(speeds) - 1 - behind)]))
        for _ in range(each):
            held.append(command)
            data.ctrl[0] = held[max(0, len(held) - 1 - late)]
            data.qfrc_applied[0] = -cubic * data.qpos[0] ** 3
            mujoco.mj_step(model, data)
            speeds.append(float(data.qvel[0]))
    time, ctrl, qpos, speed = (np.array(c) for c in zip(*table, strict=True))
    qpos = (qpos + sigma * rng.normal(size=len(qpos)))[:, None]
    channels, noise = Channels.of(model), np.array([max(sigma, 1e-7)])
    qvel, spread = estimate_velocity(time, qpos, channels, noise)
    if late_velocity is not None:
        qvel, spread = (speed + 4 * sigma * rng.normal(size=len(speed)))[:, None], 4 * noise
    told = late_velocity is not None, channels, noise, spread
    return Log(f"log{i}", time, ctrl[:, None], qpos, qvel, *told, metadata=metadata)


def fitted(setup: Setup) -> tuple[Fitter, Fit]:
    """The fit of the known parameters alone."""
    fitter = setup.fitter
    fit = fitter.begin(fitter.base)
    (fit,) = fitter.iterate([fit], 8, lambda f: range(len(f.coordinates)))
    return fitter, fitter.refresh(fit)


def refit(setup: Setup, logs: list[Log]) -> tuple[Fitter, Fit]:
    """`fitted` on other logs of the same number and length, by the program that is already compiled."""
    simulator = copy.copy(setup.fitter.simulator)
    old, model, physics = simulator.windows, setup.physics.mj_model, setup.physics
    simulator.windows = windows.cut(logs, model, PERIOD, physics.substeps, old.steps, limit=len(old), centred=False)
    return fitted(dataclasses.replace(setup, fitter=Fitter(simulator, setup.fitter.base, setup.fitter.theta)))


def saved(folder: Path, logs: list[Log]) -> Path:
    """The logs as CSV files."""
    for log in logs:
        write_log(folder / f"{log.name}.csv", log)
    return folder
