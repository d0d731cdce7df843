"""Logs of arms with a known force that the simulator lacks, made with MuJoCo C at a tenth of the simulator's step."""

from collections.abc import Callable

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.fitting import candidates, robot, windows
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.simulator import Simulator
from bayessim_mjx.logs import Channels, Log, estimate_velocity
from bayessim_mjx.physics import Physics

DT, STEP, SIGMA = 0.02, 0.002, 4e-4  # s, s, rad
LINK = '<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="{mass}" contype="0" conaffinity="0"/>'
JOINT = '<joint name="{name}" axis="0 1 0" damping="{damping}" armature=".01" frictionloss="{friction}"/>'
Force = Callable[[float, mujoco.MjData], np.ndarray]


def arm(joints: int, step: float, wrong: float = 1.0, friction: tuple[float, ...] = (0.0, 0.0)) -> mujoco.MjModel:
    """One or two links; `wrong` scales damping and masses; friction in N m."""
    body, names = "", ("shoulder", "elbow")[:joints]
    for i in reversed(range(joints)):
        joint = JOINT.format(name=names[i], damping=0.05 * wrong, friction=friction[i])
        place = ' pos="0 0 -.4"' if i else ""
        body = f"<body{place}>{joint}{LINK.format(mass=0.5 * wrong)}{body}</body>"
    motors = "".join(f'<motor name="m_{n}" joint="{n}"/>' for n in names)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{step}"/><worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>'
    )


def record(
    joints: int = 1,
    friction: tuple[float, ...] = (0.0, 0.0),
    force: Force | None = None,
    delay: float = 0.0,
    logs: int = 8,
    seconds: float = 4.0,
    seed: int = 0,
    wrong: float = 1.06,
) -> list[Log]:
    """Closed-loop motion around sines of rising pace and size, one operating condition per log."""
    rng = np.random.default_rng(seed)
    model, fine = arm(joints, STEP / 10, wrong, friction), round(10 * DT / STEP)
    wait = round(delay / model.opt.timestep)
    out = []
    for i in range(logs):
        data, rows, queue = mujoco.MjData(model), [], [np.zeros(joints)] * (wait + 1)
        data.qpos[:] = 0.3 * rng.standard_normal(joints)
        phase = rng.uniform(0, 6.28, (2, joints))
        for k in range(round(seconds / DT) + 1):
            t = k * DT
            pace = 2 * np.pi * (0.3 + 0.15 * i) * np.array([1.0, 1.37])[:joints]
            target = (0.4 + 0.1 * i) * np.sin(pace * t + phase[0]) + 0.2 * np.sin(2.7 * pace * t + phase[1])
            command = 8.0 * (target - data.qpos) - 0.5 * data.qvel
            rows.append(np.r_[t, command, data.qpos])
            for _ in range(fine):
                queue.append(command)
                data.ctrl[:] = queue[-1 - wait]
                if force is not None:
                    mujoco.mj_forward(model, data)
                    data.qfrc_applied[:] = force(data.time, data)
                mujoco.mj_step(model, data)
        table = np.array(rows)
        qpos = table[:, 1 + joints :] + SIGMA * rng.standard_normal((len(table), joints))
        channels, sigma = Channels.of(model), np.full(joints, SIGMA)
        speed, spread = estimate_velocity(table[:, 0], qpos, channels, sigma)
        out.append(Log(f"log{i}", table[:, 0], table[:, 1 : 1 + joints], qpos, speed, False, channels, sigma, spread))
    return out


def fitted(logs: list[Log], iterations: int = 8) -> tuple[Fitter, Fit]:
    """The simulator's own parameters fitted to the logs, with fresh columns."""
    model = arm(logs[0].qpos.shape[1], STEP)
    space = robot.default_space(model)
    physics = Physics(model, DT, space, ())
    cut = windows.cut(logs, model, DT, physics.substeps, 25, limit=64)
    fitter = Fitter(Simulator(physics, cut, lanes=512), candidates.base_coordinates(space), physics.space.nominal)
    fit = fitter.begin(fitter.base)
    if iterations:
        (fit,) = fitter.iterate([fit], iterations, lambda f: range(len(f.coordinates)))
    return fitter, fitter.refresh(fit)


def known(logs: list[Log]) -> tuple[Fitter, Fit]:
    """A fit that knows all parameters: none is free."""
    fitter, _ = fitted(logs, iterations=0)
    return fitter, fitter.begin(())
