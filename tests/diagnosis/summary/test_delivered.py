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


def played(real, i, noise):
    """(a log of this model with noise, its error beside the model as delivered)."""
    own, channels, sigma = mujoco.MjModel.from_xml_string(HEAD), Channels.of(real), np.full(1, NOISE)
    time, qpos = PERIOD * np.arange(ROWS), angles(real, command(i)) + noise
    qvel, spread = estimate_velocity(time, qpos, channels, sigma)
    log = Log(f"log{i}", time, command(i), qpos, qvel, False, channels, sigma, spread)
    return log, qpos - angles(own, command(i))


def diagnosed(timestep, integrator):
    """(diagnosis of logs of the head at this step, noise sd that its logs are off the model as delivered)."""
    real, rng = mujoco.MjModel.from_xml_string(HEAD), np.random.default_rng(0)
    real.opt.timestep, real.opt.integrator = timestep, integrator
    each = [played(real, i, NOISE * rng.normal(size=(ROWS, 1))) for i in range(4)]
    spec = mujoco.MjSpec.from_string(HEAD)
    found = diagnose(spec, [log for log, _ in each], effects=["coulomb_friction"], quick=True, verdict_only=True)
    return found, float(np.sqrt(np.mean(np.square([off for _, off in each])))) / NOISE


def test_where_nothing_is_hidden_the_time_step_is_the_gap():
    """Recorded by RK4 at .1 ms: of the real head nothing is missing, and no parameter is off."""
    found, delivered = diagnosed(1e-4, mujoco.mjtIntegrator.mjINT_RK4)
    assert delivered > 4 and found.gap.horizons[-1]["nominal"] == pytest.approx(delivered, rel=0.15)
    assert found.gap.nominal > 3 > 1.15 > found.gap.with_effects
    assert found.verdict == "no_gap" and found.sentences[0].startswith("No gap but the time step: at 5 ms (implicit")
    assert sum("time step of 5 ms (implicitfast) costs" in text for text in found.warnings) == 1


def test_logs_of_the_delivered_simulator_itself_show_no_gap():
    """By RK4 their commands seem to act half a step early, and are moved; as recorded they leave the noise."""
    found, delivered = diagnosed(STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    assert any("commands seem shifted" in text for text in found.warnings)
    assert delivered == pytest.approx(1.0, rel=0.1) and found.gap.nominal < 1.1
    assert found.gap.horizons[-1]["nominal"] < 1.1
    assert found.verdict == "no_gap" and found.sentences[0].startswith("No gap above the noise")
