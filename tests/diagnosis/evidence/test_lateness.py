"""Where all commands or all measurements are late, positions are the same: no log of both separates the two."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis import run
from tests.diagnosis import pendulums


@pytest.mark.slow
@pytest.mark.ci
def test_a_late_command_is_no_late_measurement(tmp_path):
    """The odds of the two are those of their priors, 1 to 1; strong evidence would be 20 to 1. Their number is one."""
    logs = pendulums.recorded(delay=0.03, count=6)
    robot = pendulums.nominal(tmp_path)
    found = run.diagnose(robot, logs, effects=["actuator_delay", "sensor_delay"], verdict_only=True)
    (answer,) = found.answers
    chance = {member["effects"][0].split("@")[0]: member["probability"] for member in answer["members"]}
    assert found.verdict == "ambiguous" and chance.keys() == {"actuator_delay", "sensor_delay"}
    assert abs(np.log(chance["actuator_delay"] / chance["sensor_delay"])) < np.log(5.0)
    assert answer["number"]["low"] < 0.03 < answer["number"]["high"]
