"""The gap as delivered is that of the model as it is, in windows and over whole logs: by plain MuJoCo."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import diagnose
from bayessim_mjx.logs import Channels, Log, estimate_velocity

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # a whole diagnosis

STEP, PERIOD, NOISE, ROWS = 0.005, 0.02, 5e-4, 250  # s, s, rad
HEAD = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body name="head"><joint name="pan" axis="0 1 0" damping="0.08" armature="0.01"/>
  <geom type="box" size=".05 .08 .02" mass=".6" pos=".05 0 0" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><position name="servo" joint="pan" kp="6" kv=".3"/></actuator></mujoco>"""


def command(i):
    time = PERIOD * np.arange(ROWS)
    return (0.5 * np.sin((3.0 + i) * time + i) + 0.3 * np.sign(np.sin(1.7 * time)))[:, None]


def angles(model, ctrl):
    """From rest."""
    data, out = mujoco.MjData(model), []
    for row in ctrl:
        out.append(data.qpos.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
    return np.array(out)


def test_where_nothing_is_hidden_the_time_step_is_the_gap():
    """Recorded by RK4 at .1 ms: of the real head nothing is missing, and no parameter is off."""
    own, real = (mujoco.MjModel.from_xml_string(HEAD) for _ in range(2))
    real.opt.timestep, real.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    rng, channels, sigma = np.random.default_rng(0), Channels.of(own), np.full(1, NOISE)
    time, logs, off = PERIOD * np.arange(ROWS), [], []
    for i in range(4):
        qpos = angles(real, command(i)) + NOISE * rng.normal(size=(ROWS, 1))
        qvel, spread = estimate_velocity(time, qpos, channels, sigma)
        logs.append(Log(f"log{i}", time, command(i), qpos, qvel, False, channels, sigma, spread))
        off.append(qpos - angles(own, command(i)))
    delivered = float(np.sqrt(np.mean(np.square(off)))) / NOISE
    found = diagnose(mujoco.MjSpec.from_string(HEAD), logs, effects=["coulomb_friction"], quick=True)
    whole = found.gap.horizons[-1]
    assert delivered > 4 and whole["nominal"] == pytest.approx(delivered, rel=0.15)
    assert found.gap.nominal > 3 > 1.15 > found.gap.with_effects
    assert found.verdict == "no_gap" and found.sentences[0].startswith("No gap but the time step: at 5 ms (implicit")
    assert sum("time step of 5 ms (implicitfast) costs" in text for text in found.warnings) == 1
