"""The command that tests a finished run: what it says, what it leaves, what it refuses."""

import dataclasses
import io
import json
import types

import numpy as np
import pytest

from bayessim_mjx import calibrate, config
from bayessim_mjx.inference import calibration
from bayessim_mjx.inference.calibration import Ranks
from bayessim_mjx.inference.checks import Checks
from bayessim_mjx.inference.misspecification import Misfit
from bayessim_mjx.inference.product_calibration import Count, Sets
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.monitor.writer import event_files, records
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("mass", 1.0, 0.0, 2.0), Parameter("length", 1.0, 0.0, 2.0)])


def found(power: float = 1.0, p: float = 0.4) -> Checks:
    """Ranks u^power of HPD levels: above 1 the posterior is too wide, below too narrow."""
    rng = np.random.default_rng(0)
    pit, level, tarp = rng.random((400, 2)), rng.random(400) ** power, rng.random(400)
    report = calibration.judge(Ranks(pit, level, tarp, np.full(400, 1.5), np.full((400, 2), 0.1)), SPACE)
    misfit = Misfit(
        np.array([p]), np.full((1, 3), p), np.ones((1, 3)), np.full((1, 2), p), np.array([[0.1, 9.0]]), 400,
        ("corr(angle, torque)", "variance of angle"),
    )  # fmt: skip
    return Checks(report, misfit, (), ("length: not identified by these trajectories",), 0.0)


def several(shares: tuple[float, float]) -> Sets:
    """Posteriors of 1 and 4 trajectories whose regions of p hold p^share of 100 truths; the second gains nothing."""
    even = (np.arange(100) + 0.5) / 100
    counts = [
        Count(n, 1.3, gain, 0.1, gain, even**share) for n, gain, share in zip((1, 4), (2.0, 1.9), shares, strict=True)
    ]
    return Sets(tuple(counts))


def test_posteriors_of_several_trajectories_are_told_as_they_are_used(tmp_path):
    fine = dataclasses.replace(found(), sets=several((1.0, 1.0)))
    text = said(fine)
    assert "only 1 of 4 trajectories sharpen the posterior" in text and "over-confident" not in text
    (row,) = [line for line in text.splitlines() if line.strip().startswith("4 ")]
    assert "1.30 x" in row and "1.9" in row and row.split().count("%") == 3
    narrow = said(dataclasses.replace(fine, sets=several((1.0, 0.4))))  # half the truths' levels are 0.76
    assert "warning: the posterior of 4 trajectories is over-confident as used: its 50 % region holds 18" in narrow
    calibrate.write(tmp_path / "calibration", fine, 2)
    report = json.loads((tmp_path / "calibration" / "report.json").read_text())
    assert report["sets"]["carried"] == 1 and report["sets"]["counts"][1]["trajectories"] == 4


def said(checks: Checks) -> str:
    file = io.StringIO()
    with Console(headless=True, file=file) as console:
        calibrate.show(console, checks)
    return file.getvalue()


def test_the_verdict_is_told_in_words_with_a_table():
    text = said(found())
    assert "posterior calibrated: its regions contain the truth as often as they should" in text
    assert "the real trajectories are like simulated ones, p = 0.4" in text
    (row,) = [line for line in text.splitlines() if line.strip().startswith("mass")]
    assert len(row.split()) == 5 and "too narrow [se]" in text
    (half,) = [line for line in text.splitlines() if line.strip().startswith("50 %")]
    share = float(half.split()[2])
    assert share == pytest.approx(50, abs=6)
    assert "warning: length: not identified" in text


def test_what_is_wrong_comes_with_what_to_do():
    narrow = said(found(power=0.6))
    assert "over-confident" in narrow and "bayessim.trainTrajs" in narrow
    odd = said(found(p=0.002))
    assert "unlike anything simulated, p = 0.002" in odd and "most in variance of angle" in odd


def test_report_picture_and_event_stay_and_a_second_time_replaces_the_first(tmp_path):
    folder = tmp_path / "calibration"
    for _ in range(2):
        calibrate.write(folder, found(), 3)
    report = json.loads((folder / "report.json").read_text())
    assert report["round"] == 3 and report["calibration"]["verdict"] == "calibrated"
    assert next(folder.glob("*.png")).read_bytes()[:4] == b"\x89PNG"
    events = [event for file in event_files(folder) for _, event in records(file) if event.HasField("summary")]
    tags = [(value.tag, event.step) for event in events for value in event.summary.value]
    assert tags.count(("Calibration/regions_and_ranks", 3)) == 1
    assert tags.count(("Calibration/misfit_p", 3)) == 1 and all(tag.startswith("Calibration/") for tag, _ in tags)


def test_bad_requests_are_one_line(tmp_path, monkeypatch, capsys):
    assert calibrate.main(["--run", str(tmp_path / "nothing")]) == 2
    assert calibrate.main(["--run", str(tmp_path), "--pairs", "10"]) == 2
    assert "--pairs 10: at least 40" in capsys.readouterr().err
    ablation = config.load("Pendulum", overrides=["bayessim.modelClass=None"])
    monkeypatch.setattr("bayessim_mjx.runs.Run.open", lambda path: types.SimpleNamespace(config=ablation))
    assert calibrate.main(["--run", str(tmp_path)]) == 2
    assert "the run inferred nothing" in capsys.readouterr().err
