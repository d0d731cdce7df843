"""Faults of logs' dialects that were once misread or had no way on: each is read rightly or names its key."""

from pathlib import Path

import log_dialects
import pytest

pytest.importorskip("mcap_ros2", reason="the extra [logs] is not installed")
FAULTS = {fault.name: fault for second in (False, True) for fault in log_dialects.every(second)}
MENDED = (
    "names again, and the clock too", "a counter of 24 bits at 16 MHz", "seconds of the day past midnight",
    "seconds of the GPS week past its end", "hhmmss.ss of NMEA", "ns in seven digits", "rows in bursts of five",
    "commands and positions in rows of their own", "blanks behind the colons", "what ros2 topic echo --csv writes",
    "degrees by the name shoulderPosDeg", "degrees by the name deg_shoulder",
    "degrees by the name shoulder_pos [deg] (raw)", "TimeUS", "timeMs", "a temperature in the place of a position",
    "a voltage in the place of a command", "temperatures beside positions", "desired, actual and error",
    "an error in the place of a reading", "commanded velocities of position servos", "target positions of motors",
    "an accelerometer in g", "a gyroscope in degrees per second", "a list of objects", "the last line cut off",
    "stamps as datetime64", "a packed file that is called csv", "a label with other joints",
    "a file that ends in the middle", "messages in JSON", "a clock that begins again",
    "times as a column, half precision", "joints along the first axis of an HDF5 file",
    "stamps in ns in an HDF5 file", "currents as the commands of torques",
)  # fmt: skip
WARNED = (
    "one joint in degrees, under its channel's name", "a reading that is 0 again in the middle", "two samples far off",
    "0.3 s of one value", "a floating base in mm", "a floating base with y upwards",
    "duty cycles as a servo's targets", "commands in percent of the rated torque",
)  # fmt: skip


@pytest.mark.parametrize("name", MENDED)
def test_what_was_mended_is_read_rightly_or_names_its_key(name: str, tmp_path: Path) -> None:
    outcome, said = log_dialects.tried(FAULTS[name], tmp_path)
    assert outcome in ("right", "key"), said


@pytest.mark.parametrize("name", WARNED)
def test_what_numbers_alone_cannot_prove_is_warned_of(name: str, tmp_path: Path) -> None:
    outcome, said = log_dialects.tried(FAULTS[name], tmp_path)
    assert outcome == "warned", said


def test_both_lists_are_long_and_each_fault_has_a_source() -> None:
    assert len(log_dialects.every()) >= 100 and len(log_dialects.every(second=True)) >= 30
    assert all(":" in fault.complaint or "," in fault.complaint for fault in FAULTS.values())
