"""A small floating robot with an inertial unit, played by MuJoCo C."""

import mujoco
import numpy as np

from bayessim_mjx.logs import Channels, Log, estimate_velocity

STOOL = """
<mujoco><option timestep="0.001" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="1"/></default>
<worldbody><geom name="floor" type="plane" size="5 5 .1" contype="1"/>
<body name="trunk" pos="0 0 .35"><freejoint name="root"/>
<geom type="box" size=".1 .08 .05" mass="4" conaffinity="0"/><site name="imu" pos="0.05 0.01 0.03" euler="0 0 90"/>
<body name="plate" pos="0 0 -.26"><joint name="ankle" axis="0 1 0" damping=".4" armature=".02"/>
<geom type="box" size=".12 .1 .01" mass="1.3" conaffinity="0"/>
<geom name="ahead" type="sphere" size=".02" pos=".16 0 -.03" mass=".02"/>
<geom name="left" type="sphere" size=".02" pos="-.1 .13 -.03" mass=".02"/>
<geom name="right" type="sphere" size=".02" pos="-.1 -.13 -.03" mass=".02"/></body></body></worldbody>
<actuator><position name="ankle" joint="ankle" kp="150" kv="6"/></actuator>
<sensor><gyro name="turns" site="imu"/><accelerometer name="pulls" site="imu"/>
<framequat name="stands" objtype="site" objname="imu"/></sensor></mujoco>"""
BIAS = np.array([0.02, -0.012, 0.008])  # rad/s, of the gyroscope
NOISE = {"gyro:turns": 2e-3, "accel:pulls": 2e-2, "quat:stands": 1e-4, "qpos": 2e-4}


def record(
    target=lambda t: 0.0,
    seconds: float = 4.0,
    heading: float = 0.0,
    seed: int = 0,
    quat: bool = False,
    xml: str = STOOL,
) -> tuple[Log, np.ndarray, np.ndarray]:
    """(log at 50 Hz without the base, its true pose `[T, 7]` and velocity `[T, 6]`), after a second of rest."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:7] = 0.0, 0.0, 0.31, np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)
    each, rows = round(0.02 / model.opt.timestep), {k: [] for k in ("ctrl", "q", "pose", "twist", *NOISE)}
    for k in range(round((1.0 + seconds) / 0.02)):
        t = 0.02 * k - 1.0
        data.ctrl[0] = target(max(t, 0.0))
        mujoco.mj_forward(model, data)
        if t >= 0:
            rows["ctrl"].append(data.ctrl.copy())
            rows["q"].append(data.qpos[7:].copy())
            rows["pose"].append(data.qpos[:7].copy())
            rows["twist"].append(data.qvel[:6].copy())
            for name in ("gyro:turns", "accel:pulls", "quat:stands"):
                rows[name].append(data.sensor(name.split(":")[1]).data + (BIAS if name[0] == "g" else 0.0))
        for _ in range(each):
            mujoco.mj_step(model, data)
    arrays = {k: np.array(v) for k, v in rows.items()}
    units = ("gyro:turns", "accel:pulls", *(["quat:stands"] if quat else []))
    streams = {f"{n}[{i}]": x + NOISE[n] * rng.normal(size=len(x)) for n in units for i, x in enumerate(arrays[n].T)}
    channels, qpos = Channels.of(model), np.tile(model.qpos0, (len(arrays["q"]), 1))
    qpos[:, 7:] = arrays["q"] + NOISE["qpos"] * rng.normal(size=arrays["q"].shape)
    time, sigma = 0.02 * np.arange(len(qpos)), np.full(8, NOISE["qpos"])
    rates, spread = estimate_velocity(time, qpos, channels, sigma)
    absent = tuple(f"qpos:{n}" for n in channels.of_joint("root"))
    given = {"ctrl": arrays["ctrl"], "qpos": qpos, "qvel": rates, "has_qvel": False, "streams": streams}
    log = Log("run.csv", time, **given, channels=channels, sigma_qpos=sigma, sigma_qvel=spread, absent=absent)
    return log, arrays["pose"], arrays["twist"]


def swaying(t: float) -> float:
    """Targets of the ankle, rad."""
    return 0.05 * np.sin(5.0 * t) + 0.03 * np.sin(9.0 * t)
