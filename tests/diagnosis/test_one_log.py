"""One log is one operating condition: what a diagnosis says of it."""

import pytest

from bayessim_mjx.diagnosis import run
from tests.diagnosis.pendulums import nominal, recorded

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses

FRICTION = 0.04  # N m


def test_one_log_is_one_condition_and_in_sample(tmp_path):
    logs = recorded(friction=FRICTION, scale=(0.95, 1.04, 0.97), count=3, seconds=5.0)[1:2]
    found = run.diagnose(nominal(tmp_path), logs, effects=("coulomb_friction",), quick=True, verdict_only=True)
    said = found.to_dict()
    assert said["about"]["conditions"] == 1 and said["gap"]["in_sample"]
    assert said["gap"]["closed"]["ci"] == [None, None] and said["gap"]["closed"]["elsewhere"] is None
    assert not said["gap"]["closed"]["nested"]
    (effect,) = said["effects"]
    assert effect["gap_closed_ci"] == [None, None] and effect["gap_closed"] > 0.9
    level = effect["parameters"]["level"]
    assert abs(level["mean"] - FRICTION) < 2 * level["sd"]
    text = " ".join(said["sentences"])
    assert "in sample" in text and "parts of the log" in text and "condition that" not in text
    assert any("one log is one operating condition" in w and "in sample" in w for w in said["warnings"])
    assert any("1 of 1 whole logs are simulated with parameters fitted to them" in w for w in said["warnings"])
    assert said["gap"]["horizons"][-1]["in_sample"] == 1
    assert all(c["se"] is None for c in said["candidates"])
