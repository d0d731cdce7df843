"""Logs made with MuJoCo C, for the tests of the data gate and the channel split."""

from collections.abc import Callable

import mujoco
import numpy as np

from bayessim_mjx.logs import Channels, Log, estimate_velocity
from bayessim_mjx.logs.signals import noise_level

PENDULUM = """
<mujoco><option timestep="0.001"/>
<worldbody><body><joint name="hinge" axis="0 1 0" damping="0.05" frictionloss="0.05"/>
  <geom type="sphere" size=".05" mass="0.5" pos="0 0 -.4" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
ARM = """
<mujoco><option timestep="0.001"/>
<worldbody>
  <body><joint name="shoulder" axis="0 1 0" damping="0.2"/>
    <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.4" mass="1.5" contype="0" conaffinity="0"/>
    <body pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass="0.8" contype="0" conaffinity="0"/></body></body>
</worldbody>
<actuator><motor name="m_shoulder" joint="shoulder"/><motor name="m_elbow" joint="elbow" gear="2"/></actuator>
</mujoco>"""
Law = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


def sines(size: tuple[float, ...], pace: float = 0.5, seed: int = 0) -> Law:
    """Open-loop commands: three sines per actuator."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, (3, len(size)))
    rates = 2 * np.pi * pace * np.outer([1.0, 1.7, 3.1], rng.uniform(0.9, 1.1, len(size)))
    return lambda t, q, v: np.array(size) * np.sin(rates * t + phase).sum(0) / 2


def record(
    xml: str,
    law: Law,
    seconds: float = 8.0,
    period: float = 0.01,
    sigma: float = 2e-4,
    seed: int = 0,
    name: str = "run.npz",
    qvel: bool = False,
    delay: float = 0.0,
    **more: object,
) -> Log:
    """Play a law and record what it does; `more` goes into the log's metadata. delay: s until a command acts."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    each, rows, queue = round(period / model.opt.timestep), [], []
    for k in range(round(seconds / period)):
        u = law(k * period, data.qpos.copy(), data.qvel.copy())
        rows.append(np.r_[k * period, u, data.qpos, data.qvel])
        for _ in range(each):
            queue.append(u)
            data.ctrl[:] = queue[max(0, len(queue) - 1 - round(delay / model.opt.timestep))]
            mujoco.mj_step(model, data)
    table = np.array(rows)
    nu, nq = model.nu, model.nq
    qpos = table[:, 1 + nu : 1 + nu + nq] + sigma * rng.standard_normal((len(table), nq))
    return make(model, table[:, 0], table[:, 1 : 1 + nu], qpos, table[:, 1 + nu + nq :] if qvel else None, name, more)


def make(
    model: mujoco.MjModel,
    time: np.ndarray,
    ctrl: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray | None = None,
    name: str = "run.npz",
    metadata: dict | None = None,
    streams: dict | None = None,
) -> Log:
    """A log from arrays, with its noise estimated as the reader does."""
    channels = Channels.of(model)
    sigma = np.array([noise_level(c) for c in qpos.T])
    rates, spread = estimate_velocity(time, qpos, channels, sigma)
    return Log(
        name=name,
        time=time,
        ctrl=ctrl,
        qpos=qpos,
        qvel=rates if qvel is None else qvel,
        has_qvel=qvel is not None,
        channels=channels,
        sigma_qpos=sigma,
        sigma_qvel=spread,
        streams=streams or {},
        metadata=metadata or {},
    )
