"""Entries that go with their stated source and are not it: of another angle, in degrees, or of several joints."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
pytest.importorskip("onnx", reason="the extra [export] is not installed")

from bayessim_mjx.contract import words  # noqa: E402
from bayessim_mjx.contract.check import check  # noqa: E402
from tests.contract import robots  # noqa: E402
from tests.contract.test_check import PLACES, changed, names, of_a_circle  # noqa: E402

WAVES = (np.sin, np.cos)


@pytest.fixture
def small_knee(monkeypatch: pytest.MonkeyPatch) -> None:
    """The knee moves little, so that the hip's angle and the sum of both are alike."""
    own = robots.motion

    def motion(seed: int, steps: int) -> dict[str, np.ndarray]:
        m = own(seed, steps)
        factor = np.array([1.0, 0.5])
        return {**m, "q": factor * m["q"], "v": factor * m["v"]}

    monkeypatch.setattr(robots, "motion", motion)


def found(tmp_path: Path, angle: Any, noise: float = 0.0) -> tuple[Any, set]:
    policy = robots.write_policy(tmp_path / "policy.onnx", of_a_circle())
    for seed in range(2):
        wrong = changed(PLACES, lambda m, k, x: [wave(angle(m["q"][k])) for wave in WAVES])
        robots.write_log(tmp_path / "logs" / f"run{seed}.csv", wrong, noise=noise, seed=seed)
    result = check(policy, tmp_path / "logs")
    return result, {(f.kind, f.found, f.entries) for f in result.findings}


@pytest.mark.usefixtures("small_knee")
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_an_absolute_angle_in_place_of_the_joints_own_is_named(noise: float, tmp_path: Path) -> None:
    _, got = found(tmp_path, lambda q: q[0] + q[1], noise)
    assert got == {
        ("other_source", f"{kind} of hip + knee", (name,))
        for kind, name in zip(("sin", "cos"), names(PLACES), strict=True)
    }


@pytest.mark.parametrize("noise", [0.0, 0.0003])
def test_a_sine_of_degrees_is_named_although_it_jumps_from_row_to_row(noise: float, tmp_path: Path) -> None:
    _, got = found(tmp_path, lambda q: np.degrees(q[0]), noise)
    assert got == {("unit", "degrees", names(PLACES))}


def test_what_follows_from_its_source_in_part_alone_is_off_by_the_rest(tmp_path: Path) -> None:
    policy = robots.write_policy(tmp_path / "policy.onnx")
    wrong = changed(PLACES, lambda m, k, x: x + [0.7 * x[1], 0.0])
    robots.write_log(tmp_path / "logs" / "run.csv", wrong)
    (finding,) = check(policy, tmp_path / "logs").findings
    assert (finding.kind, finding.entries) == ("beyond", ("hip_position",))
    assert "off what its source, timing and noise explain" in words.sentence(finding)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_an_observation_of_a_poor_sensor_is_unknown_and_not_wrong(noise: float, tmp_path: Path) -> None:
    policy = robots.write_policy(tmp_path / "policy.onnx", of_a_circle())
    for seed in range(4):
        rng = np.random.default_rng(seed)
        poor = changed(PLACES, lambda m, k, x: [f(m["q"][k][0]) + rng.normal() for f in WAVES])  # noqa: B023
        robots.write_log(tmp_path / "logs" / f"run{seed}.csv", poor, noise=noise, seed=seed)
    result = check(policy, tmp_path / "logs")
    assert not result.findings and {result.untold[name] for name in names(PLACES)} == {"noise"}


@pytest.mark.parametrize("grain", [0.01, 0.05])
@pytest.mark.parametrize("late", [-0.4, 0.4])
def test_coarse_encoders_and_a_log_that_is_written_late_are_right(grain: float, late: float, tmp_path: Path) -> None:
    policy = robots.write_policy(tmp_path / "policy.onnx")
    log = robots.write_log(tmp_path / "logs" / "run.csv")
    header = log.read_text().splitlines()[0]
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    for i, name in enumerate(header.split(",")):
        if name in ("qpos:hip", "qpos:knee"):
            shifted = np.interp(rows[:, 0] - late * robots.DT, rows[:, 0], rows[:, i])
            rows[:, i] = grain * np.round(shifted / grain)
    np.savetxt(log, rows, "%.9g", ",", header=header, comments="")
    assert not check(policy, tmp_path / "logs").findings
