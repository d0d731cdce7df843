"""Jumps between calm rows are named, and fast motion, slow starts and coarse encoders are not."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.logs import Channels, read_logs
from bayessim_mjx.logs.doubts import _held_by_its_range
from bayessim_mjx.logs.importers import cdr
from tests.logs.log_files import rows, write

T = 0.01 * np.arange(200)


def said(tmp_path: Path, arm: mujoco.MjModel, elbow: np.ndarray) -> list[str]:
    """Return the warnings of a log whose elbow moves so."""
    table = rows(200)
    table[:, 3] = 0.5 * np.sin(2 * T)
    table[:, 4] = elbow
    write(tmp_path, table)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        read_logs(tmp_path, arm)
    return [str(w.message) for w in found]


@pytest.mark.parametrize(
    ("kind", "line"),
    [("again from 0", 102), ("one sample off", 82), ("one value for a while", 112)],
)
def test_a_jump_is_named_with_its_line(kind: str, line: int, tmp_path: Path, arm: mujoco.MjModel) -> None:
    x, k = 0.6 * np.cos(3 * T), np.arange(200)
    shown = {
        "again from 0": np.where(k < 100, x, x - x[100]),
        "one sample off": np.where(k == 80, x + 0.4, x),
        "one value for a while": np.where((k >= 80) & (k < 110), x[80], x),
    }[kind]
    (text,) = said(tmp_path, arm, shown)
    assert "'qpos:elbow'" in text and f"line {line}: it jumps from" in text and "cut the file there" in text


@pytest.mark.parametrize(
    "elbow",
    [
        0.9 * np.sign(np.sin(9 * T)) * (1 - np.exp(-40 * (T % 0.349))),  # steps of a stiff servo
        0.3 * np.maximum(T - 0.02, 0) ** 2,  # from rest
        np.round(0.2 * np.sin(T) / 0.05) * 0.05,  # an encoder of few counts
        0.02 * np.random.default_rng(0).normal(size=200),  # noise alone
    ],
    ids=["steps", "start", "counts", "noise"],
)
def test_motion_is_no_jump(elbow: np.ndarray, tmp_path: Path, arm: mujoco.MjModel) -> None:
    assert not [text for text in said(tmp_path, arm, elbow) if "jumps" in text]


def test_each_signal_may_have_rows_of_its_own(tmp_path: Path, arm: mujoco.MjModel) -> None:
    """Commands are means over the rows of the positions, other joints are interpolated."""
    lines = ["time,ctrl:m_shoulder,ctrl:m_elbow,qpos:shoulder,qpos:elbow"]
    for k in range(40):
        t = 0.01 * k
        lines += [f"{t - 0.005:.4f},{k},{-k},,", f"{t:.4f},,,{0.1 * t:.6f},"]
        lines += [f"{t + 0.001:.4f},,,,{0.2 * t + 0.0002:.6f}"]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match="each signal has rows of its own; they are brought onto the 39 rows"):
        (log,) = read_logs(tmp_path, arm)
    np.testing.assert_allclose(log.qpos[:, 1], 2 * log.qpos[:, 0], atol=1e-6)
    np.testing.assert_allclose(log.ctrl[:-1, 0], np.arange(1, 39) + 0.5)


def test_numbers_are_decoded_as_the_general_decoder_does() -> None:
    """A message of another form than the first decoder knows is left to the general one."""
    calls = []

    def slow(data: bytes) -> object:
        calls.append(data)
        return cdr.NumberArray(layout=None, data=np.zeros(1))

    decode = cdr.faster("Float64MultiArray", slow)
    for _ in range(3):
        decode(b"\x00\x00 another order of bytes")
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("angle", "reach", "gear", "warned"),
    [("degree", 1.8, 1, True), ("radian", 1.8, 1, False), ("radian", 6.2, 1, False), ("radian", 90.0, 50, False)],
)
def test_a_range_in_rad_that_the_model_reads_as_degrees_is_named(angle, reach, gear, warned):
    """Ranges beside the commands of a servo; those may reach beyond the range, and stand before a gear."""
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco><compiler angle="{angle}" autolimits="true"/><worldbody><body name="arm">
        <joint name="lift" axis="0 1 0" limited="true" range="-1.8 1.8"/><geom size=".1"/></body></worldbody>
      <actuator><position name="servo" joint="lift" kp="9" gear="{gear}" ctrlrange="-{reach} {reach}"/>
      </actuator></mujoco>""")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        held = _held_by_its_range(model, 0, 0, Channels.of(model))
    assert held == warned == any("angles in an MJCF are degrees" in str(w.message) for w in found)
