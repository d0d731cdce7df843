"""`bayessim-mjx policy check`: exit codes, table, JSON, and what is wrong with its input."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
pytest.importorskip("onnx", reason="the extra [export] is not installed")

from bayessim_mjx import policy_check  # noqa: E402
from tests.contract import robots  # noqa: E402


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return robots.write_policy(tmp_path / "policy.onnx")


def run(*argv: object) -> int:
    return policy_check.main(["check", *map(str, argv)])


def test_right_is_0(policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    robots.write_log(tmp_path / "logs" / "run.csv")
    assert run(policy, "--logs", tmp_path / "logs") == 0
    assert "is as its file says" in capsys.readouterr().out


def test_a_difference_is_1_and_is_written(policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    robots.write_log(tmp_path / "logs" / "run.csv", command=lambda a: robots.HOME + 0.25 * a)
    assert run(policy, "--logs", tmp_path / "logs", "--out", tmp_path / "found.json") == 1
    assert "scale 0.25 in place of 0.5 (it is applied twice)" in capsys.readouterr().out
    facts = json.loads((tmp_path / "found.json").read_text())
    assert facts["verdict"] == "differs" and facts["findings"][0]["kind"] == "scale_twice"


def test_a_log_that_shows_nothing_is_1_with_a_way_on(
    policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    log = robots.write_log(tmp_path / "logs" / "run.csv", drop=("observation", "action", "qpos", "qvel"))
    assert run(policy, "--logs", log, "--out", tmp_path / "found.json") == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "error: nothing of observations" in out and "Log observation:<name> and action:<actuator>" in out, out
    assert json.loads((tmp_path / "found.json").read_text())["verdict"] == "not compared"


def test_another_policy_of_which_only_the_state_is_logged_differs(
    policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    other = lambda o: np.tanh((o - 0.1) / 0.6 @ robots.weights(7))  # noqa: E731
    log = robots.write_log(tmp_path / "logs" / "run.csv", acted=other, drop=("observation", "action"))
    assert run(policy, "--logs", log, "--out", tmp_path / "found.json") == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "differs: the actions do not follow from the logged state" in out and "error" not in out, out
    assert json.loads((tmp_path / "found.json").read_text())["verdict"] == "differs"


def test_what_is_right_names_what_the_log_does_not_show(
    policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    robots.write_log(tmp_path / "logs" / "run.csv", drop=("qpos:hip", "qvel:hip"))
    assert run(policy, "--logs", tmp_path / "logs") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "the deployed policy is as its file says, except hip_position, " in out, out
    assert out.endswith("which the log does not show")


def test_bad_input_is_2(policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log = robots.write_log(tmp_path / "logs" / "run.csv")
    assert run(tmp_path / "none.onnx", "--logs", tmp_path / "logs") == 2
    assert "no such file" in capsys.readouterr().err
    assert run(policy, "--logs", tmp_path / "nowhere") == 2
    assert "nowhere" in capsys.readouterr().err
    log.write_text(log.read_text().replace("observation:hip_position", "observation:hipp", 1))
    assert run(policy, "--logs", tmp_path / "logs") == 2
    assert "observation:hipp" in capsys.readouterr().err
    (tmp_path / "bad.json").write_text("[1]")
    assert run(policy, "--logs", tmp_path / "logs", "--manifest", tmp_path / "bad.json") == 2
    assert "no JSON object" in capsys.readouterr().err


def test_an_older_file_says_what_it_lacks(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    old = robots.manifest()
    meaning = old.pop("observation_meaning")
    policy = robots.write_policy(tmp_path / "old.onnx", old)
    robots.write_log(
        tmp_path / "logs" / "run.csv", lambda m, k, a: robots.observe(m, k, a) * np.array([1.0] * 6 + [-1, 1] + [1] * 4)
    )
    assert run(policy, "--logs", tmp_path / "logs") == 0
    assert "exported by an older version" in capsys.readouterr().out
    (tmp_path / "more.json").write_text(json.dumps({"observation_meaning": meaning}))
    assert run(policy, "--logs", tmp_path / "logs", "--manifest", tmp_path / "more.json") == 1
    assert "hip_position" in capsys.readouterr().out


def test_golden_pairs_of_another_machine(policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    robots.write_log(tmp_path / "logs" / "run.csv")
    seen = np.random.default_rng(0).normal(size=(4, len(robots.NAMES)))
    pairs = {"observation": seen.tolist(), "action": robots.act(seen).tolist()}
    (tmp_path / "golden.json").write_text(json.dumps(pairs))
    assert run(policy, "--logs", tmp_path / "logs", "--golden", tmp_path / "golden.json") == 0
    pairs["action"] = (0.1 + robots.act(seen)).tolist()
    (tmp_path / "golden.json").write_text(json.dumps(pairs))
    assert run(policy, "--logs", tmp_path / "logs", "--golden", tmp_path / "golden.json") == 1
    assert "differ" in capsys.readouterr().out


def test_arrays_are_named_by_the_model(policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log = robots.write_log(tmp_path / "logs" / "run.csv")
    for old, new in (
        ("qpos:hip", "qpos[7]"),
        ("qpos:knee", "qpos[8]"),
        ("qvel:hip", "qvel[6]"),
        ("qvel:knee", "qvel[7]"),
    ):
        log.write_text(log.read_text().replace(old, new, 1))
    assert run(policy, "--logs", tmp_path / "logs") == 2
    assert "--model" in capsys.readouterr().err
    joints = "".join(f"<body><joint name='{j}'/><geom size='.1'/></body>" for j in robots.JOINTS)
    motors = "".join(f"<motor joint='{j}'/>" for j in robots.JOINTS)
    base = f"<body><freejoint name='root'/><geom size='.1'/>{joints}</body>"
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{base}</worldbody><actuator>{motors}</actuator></mujoco>")
    assert run(policy, "--logs", tmp_path / "logs", "--model", tmp_path / "robot.xml") == 0
