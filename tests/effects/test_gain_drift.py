"""A gain that drifts with the time of the recording, by hand."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.logs.log import Channels, Log

MODEL = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint name="x"/><geom size=".1"/></body><body><joint name="y"/><geom size=".1"/></body>'
    '</worldbody><actuator><motor name="one" joint="x"/><motor name="two" joint="y"/></actuator></mujoco>'
)


class Step:
    dt = 0.5


@pytest.mark.parametrize(("time", "factor"), [(None, 1.0), (30.0, 1.1), (60.0, 1.2)])
def test_grows_with_the_minutes_of_the_recording(time, factor):
    effect = make("gain_drift", where="two")
    at = effect.bind(MODEL, 0.5, 1)
    motion = Motion(jnp.zeros((1, 2)), jnp.zeros((1, 2)), jnp.zeros((1, 1, 2)), 0, time)
    memory, _ = effect.on_start(at, effect.init(at), motion, jnp.array([0.2]))
    memory, force = effect.on_actuator(at, memory, Step(), jnp.array([3.0, 2.0]), jnp.array([0.2]))
    np.testing.assert_allclose(force, [3.0, 2.0 * factor], rtol=1e-6)
    _, later = effect.on_actuator(at, memory, Step(), jnp.array([3.0, 2.0]), jnp.array([0.2]))
    assert later[1] == pytest.approx(2.0 * (factor + 0.2 * 0.5 / 60), rel=1e-5)  # half a second on


def test_windows_know_when_they_begin():
    """Seconds since the recording began, whatever its clock showed then; also in the second piece of a file."""

    def piece(name, first):
        time = 1000 + first + 0.02 * np.arange(200)
        swing = np.stack([np.sin(time), np.cos(time)], 1)
        channels = Channels.of(MODEL)
        noise = np.full(2, 1e-3)
        return Log(name, time, swing, swing, swing, True, channels, noise, noise, {}, {"source": "run.csv"})

    cut = windows.cut([piece("run#1", 0.0), piece("run#2", 90.0)], MODEL, 0.02, 2, 10, limit=8)
    np.testing.assert_allclose(cut.batch.around.time, 90.0 * cut.log + cut.start * 0.02, atol=1e-4)
    assert set(cut.log) == {0, 1}
