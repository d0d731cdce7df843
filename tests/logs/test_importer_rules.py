"""What the importers make of messages and names: topics, trajectories, clocks, gaps, models."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.ros import Choice, Message, recording
from bayessim_mjx.logs.importers.streams import Recording, Stream
from tests.logs.importing import START, call, error, model_of, named, read, stamp


def bodies(topics: dict[str, Callable[[int], Any]], kinds: dict[str, str], count: int = 20) -> list[Message]:
    return [Message(t, kinds[t], START + 10_000_000 * k, make(k)) for t, make in topics.items() for k in range(count)]


def states(k: int) -> Any:
    t = 0.01 * k
    return named(header=stamp(START + 10_000_000 * k), name=["elbow"], position=[t], velocity=[1.0], effort=[])


def test_trajectories_run_from_point_to_point_and_give_way_to_later_ones() -> None:
    def plan(k: int) -> Any:
        points = [named(positions=[x], velocities=[], effort=[], time_from_start=named(sec=0, nanosec=ns))
                  for x, ns in ((0.1 * k, 0), (0.1 * (k + 2), 20_000_000))]  # fmt: skip
        return named(header=stamp(0), joint_names=["elbow"], points=points)

    kinds = {"/joint_states": "JointState", "/plan": "JointTrajectory"}
    columns, _ = recording("run", bodies({"/joint_states": states, "/plan": plan}, kinds), Choice()).columns()
    # a ramp of 0.1 each 10 ms, however often it is planned anew; its mean over a row lies half a row later
    np.testing.assert_allclose(columns["command:elbow"][:18], 0.1 * np.arange(18) + 0.05, atol=1e-9)
    assert columns["velocity:elbow"][3] == 1.0 and "effort:elbow" not in columns


def test_what_cannot_be_told_is_asked_for() -> None:
    def both(k: int) -> Any:
        return named(header=stamp(START + 10_000_000 * k), name=["elbow"], position=[0.1], velocity=[k], effort=[])

    kinds = {"/a/joint_states": "JointState", "/joint_command": "JointState", "/b/joint_states": "JointState"}
    two = bodies({"/a/joint_states": states, "/joint_command": both}, kinds)
    with pytest.raises(UserError, match="/joint_command commands position and velocity; allowed: --field"):
        recording("run", two, Choice())
    found = recording("run", two, Choice(field="velocity"))
    np.testing.assert_allclose(found.columns()[0]["command:elbow"][:19], np.arange(19))
    three = two + bodies({"/b/joint_states": states}, kinds)
    with pytest.raises(UserError, match="2 topics of joint states.*--states TOPIC"):
        recording("run", three, Choice(field="velocity"))
    recording("run", three, Choice(field="velocity", states="/b/joint_states"))
    with pytest.raises(UserError, match="no topic of commands; it has /a/joint_states"):
        recording("run", [m for m in two if m.topic == "/a/joint_states"], Choice())
    with pytest.raises(UserError, match="--commands /nope: no such topic"):
        recording("run", two, Choice(commands={"/nope": ()}))


def test_headers_of_another_clock_are_not_mixed_with_times_of_receipt() -> None:
    def simulated(k: int) -> Any:
        return named(header=stamp(10_000_000 * (k + 1)), name=["elbow"], position=[0.01 * k], velocity=[], effort=[])

    kinds = {"/joint_states": "JointState", "/u": "Float64"}
    messages = bodies({"/joint_states": simulated, "/u": lambda k: named(data=float(k))}, kinds)
    found = recording("run", messages, Choice())
    assert any("--stamps received" in note for note in found.notes)
    np.testing.assert_allclose(found.columns()[0]["command:elbow"][:19], np.arange(19))


def test_one_clock_keeps_impulses_and_marks_what_was_not_sampled() -> None:
    clock = 0.01 * np.arange(100)
    positions = {"a": Stream(clock, np.sin(clock)), "b": Stream(clock[10:80] + 0.004, clock[10:80])}
    rng = np.random.default_rng(0)
    times, sizes = np.sort(rng.uniform(0.05, 0.9, 300)), rng.normal(size=300)
    gap = np.r_[0:40, 60:100]
    run = Recording("run", positions, {"a": Stream(times, sizes, "held")}, others={"x": Stream(clock[gap], clock[gap])})
    columns, left_out = run.columns()
    kept = clock[left_out_rows(clock)]
    assert left_out == 100 - len(kept) and columns["time"][0] == 0
    np.testing.assert_allclose(columns["position:b"], kept - 0.004, atol=1e-12)
    impulse = np.sum(sizes * np.clip(np.append(times[1:], 9), kept[0], 0.8) - sizes * np.clip(times, kept[0], 0.8))
    assert 0.01 * np.sum(columns["command:a"]) == pytest.approx(impulse, abs=1e-9)
    assert np.isnan(columns["x"]).sum() == 20
    with pytest.raises(UserError, match="no time at which all joints.*command a 5.000 to 6.000 s"):
        Recording("run", positions, {"a": Stream(np.array([5.0, 6.0]), np.ones(2), "held")}).columns()


def left_out_rows(clock: np.ndarray) -> np.ndarray:
    """Rows within the samples of joint b, 0.104 to 0.794 s."""
    return (clock > 0.104) & (clock < 0.7941)


def test_names_are_those_of_the_model_and_what_is_missing_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra [logs] is not installed")
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        file["q"], file["u"] = np.sin(np.arange(40) / 9)[:, None], np.ones((40, 1))
    arrays = ("--positions", "q", "--commands", "u", "--rate", "100", "--joints", "j1")
    start = ("from-hdf5", tmp_path / "run.hdf5", *arrays)
    with_model = (*start, "--model", model_of(tmp_path))
    assert "no recorded joint is in the model" in error(capsys, *with_model, "--out", tmp_path / "a")
    told = call(capsys, *with_model, "--rename", "j1=elbow", "--out", tmp_path / "b")
    assert "joint shoulder" in told and "command of m_shoulder" in told
    log = read(tmp_path / "b")
    assert log.ctrl[0].tolist() == [0.0, 1.0] and not log.qpos[:, 0].any() and np.ptp(log.qpos[:, 1]) > 1
    call(capsys, *start, "--out", tmp_path / "c")
    assert "j1: position:j1" in (tmp_path / "c" / "map.yaml").read_text()
    assert "--rename j1" in error(capsys, *with_model, "--rename", "j1", "--out", tmp_path / "d")
    assert "--rate 0" in error(capsys, *start[:6], "--rate", "0", "--out", tmp_path / "d")
    assert "--scale 0" in error(capsys, *start, "--scale", "0", "--out", tmp_path / "d")
    assert "no such file" in error(capsys, "from-hdf5", tmp_path / "nope.h5", "--rate", "1", "--out", tmp_path / "d")


@pytest.mark.parametrize("name", [name for name in import_logs.FORMATS if name != "from-pace"])  # it needs none
def test_a_package_that_is_missing_is_one_line(name: str, tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    from bayessim_mjx.logs.importers import needs

    def absent(module: str) -> Any:
        raise ImportError(f"No module named {module!r}")

    monkeypatch.setattr(needs, "import_module", absent)
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.parquet").touch()
    (tmp_path / "meta" / "info.json").write_text('{"fps": 10, "features": {"action": {}}}')
    more = ["--rate", "10"] if name == "from-hdf5" else []
    text = error(capsys, name, tmp_path, "--out", tmp_path / "logs", *more)
    assert f"{name} needs the package" in text and "bayessim-mjx[logs]" in text
