"""Ranges of effects follow the robot and its logs."""

import mujoco
import pytest

from bayessim_mjx import effects
from bayessim_mjx.diagnosis.fitting import scales
from tests.diagnosis.recordings import PENDULUM, record, sines


@pytest.mark.parametrize(("period", "command", "sensor"), [(0.01, 0.1, 0.05), (0.02, 0.1, 0.06), (0.1, 0.3, 0.3)])
def test_delays_reach_over_three_rows_of_a_slow_log(period, command, sensor):
    """A bus of 10 Hz is late by its own period, whatever fast drives do."""
    log = record(PENDULUM, sines((1.5,)), seconds=80 * period, period=period)
    size = scales.measure(mujoco.MjModel.from_xml_string(PENDULUM), [log])
    for name, place, high in (("actuator_delay", "motor", command), ("sensor_delay", "hinge", sensor)):
        (delay,) = scales.ranges(effects.load(name), place, size)
        assert delay.low == 0.0 and delay.high == pytest.approx(high)
