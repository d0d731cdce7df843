"""Which rows of a log move freely: not those that the filter blends with a contact."""

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.regressor import motion
from bayessim_mjx.logs import Channels, Log, estimate_velocity

FALLING = """<mujoco><option timestep=".001"/><worldbody><geom type="plane" size="1 1 .1"/>
<body pos="0 0 1"><joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""
PERIOD, CUTOFF = 0.01, 5.0  # s, Hz


def test_what_the_filter_blends_with_a_contact_is_not_free():
    """A ball touches the floor after sqrt(2 * .9 / 9.81) = .428 s and stays; .1 s before, its filtered motion knows."""
    model = mujoco.MjModel.from_xml_string(FALLING)
    data, qpos = mujoco.MjData(model), []
    for _ in range(100):
        qpos.append(data.qpos.copy())
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
    time, channels, sigma = PERIOD * np.arange(100), Channels.of(model), np.full(1, 1e-5)
    qvel, spread = estimate_velocity(time, np.array(qpos), channels, sigma)
    log = Log("ball", time, np.zeros((100, 0)), np.array(qpos), qvel, False, channels, sigma, spread)
    found = motion(log, model, CUTOFF)
    free = found.time[found.free]
    assert free.min() <= 0.5 / CUTOFF + 2 * found.step
    assert 0.25 < free.max() < 0.428 - 0.5 / CUTOFF + found.step
