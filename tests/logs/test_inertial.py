"""Files with an inertial unit: its own rate, names, and a floating base without a pose."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import read_logs
from tests.odometry.floating import STOOL


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(STOOL)


def table(rows: int = 81, unit: str = "turns", encoders: int = 2) -> tuple[str, np.ndarray]:
    """CSV text of a unit at 200 Hz over encoders that have every second row; and the unit's rates."""
    time = 0.005 * np.arange(rows)
    rate = np.stack([time, 2 * time**2, 0 * time + 0.3], 1)
    head = [
        "time",
        "ctrl:ankle",
        "qpos:ankle",
        *(f"gyro:{unit}[{i}]" for i in range(3)),
        *(f"accel:pulls[{i}]" for i in range(3)),
    ]
    lines = [",".join(head)]
    for k, t in enumerate(time):
        own = ["0.1", f"{0.1 * np.sin(3 * t):.6f}"] if k % encoders == 0 else ["", ""]
        lines.append(",".join([f"{t:.4f}", *own, *(f"{x:.9g}" for x in rate[k]), "0", "0", "9.81"]))
    return "\n".join(lines) + "\n", rate


def test_rows_of_a_faster_unit_keep_samples_and_means(tmp_path, model):
    text, rate = table()
    (tmp_path / "run.csv").write_text(text)
    with pytest.warns(UserWarning, match="40 rows hold samples of an inertial unit alone"):
        (log,) = read_logs(tmp_path, model, partial=True)
    assert len(log) == 41 and log.period == pytest.approx(0.01)
    assert log.streams["gyro:turns[1]"] == pytest.approx(rate[::2, 1])
    # of a straight line the mean is its middle; of 2 t^2 by straight pieces (f(t - h) + 2 f(t) + f(t + h)) / 4
    assert log.streams["mean:gyro:turns[0]"][1:-1] == pytest.approx(rate[2:-2:2, 0])
    assert log.streams["mean:gyro:turns[1]"][1:-1] == pytest.approx(rate[2:-2:2, 1] + 0.005**2)
    assert set(log.lost) == {f"qpos:root[{i}]" for i in range(7)}


def test_a_base_without_a_pose_and_without_a_unit_is_refused(tmp_path, model):
    text, _ = table(encoders=1)
    lines = [",".join(line.split(",")[:3]) for line in text.splitlines()]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    with pytest.raises(UserError, match=r"all 7 of joint 'root', or gyro:SENSOR\[0..2\]"):
        read_logs(tmp_path, model, partial=True)


def test_rows_without_encoders_throughout_are_refused(tmp_path, model):
    text, _ = table(encoders=1000)
    lines = text.splitlines()
    (tmp_path / "run.csv").write_text("\n".join([lines[0], *lines[2:]]))
    with pytest.raises(UserError, match="allowed: .* rows with all commands and positions"):
        read_logs(tmp_path, model, partial=True)


def test_a_check_shows_the_unit(tmp_path, capsys):
    text, _ = table(encoders=1)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "run.csv").write_text(text)
    (tmp_path / "stool.xml").write_text(STOOL)
    import_logs.main(["check", str(tmp_path / "logs"), "--model", str(tmp_path / "stool.xml")])
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    (gyro,) = [line for line in shown if line[:1] == ["gyro:turns[2]"]]
    assert "rad/s" in gyro and gyro[-1] == "gyroscope"


def test_a_delay_that_is_no_number_is_refused(tmp_path, model):
    (tmp_path / "run.csv").write_text(table(encoders=1)[0])
    (tmp_path / "run.yaml").write_text("imu_late: soon")
    with pytest.raises(UserError, match="imu_late = 'soon'; allowed: seconds"):
        read_logs(tmp_path, model, partial=True)
