"""The blind suite: baselines on motion whose missing effect is known, noise that lasts, and counts that are refused."""

import json
from pathlib import Path

import bic
import calibration
import kinds
import mujoco
import numpy as np
import pytest
import regression
import release
import residual
import sindy
import suite
from systems import SYSTEMS

from bayessim_mjx import atomic
from bayessim_mjx.blind.cases import KINDS
from bayessim_mjx.blind.reality.plant import Plant

ROOT = Path(__file__).resolve().parents[2]
PENDULUM = SYSTEMS["pendulum"]


def problem(folder: Path, damping: float) -> regression.Problem:
    """Logs without noise of a pendulum with more damping than its model."""
    logs = folder / "logs"
    logs.mkdir()
    (folder / "model.xml").write_text(PENDULUM.xml)
    model = mujoco.MjModel.from_xml_string(PENDULUM.xml)
    model.dof_damping[0] += damping
    model.opt.timestep /= 10
    for k, pace in enumerate((2.0, 5.0)):
        data, rows = mujoco.MjData(model), []
        for row in range(200):
            rows.append([row * 0.02, 0.8 * np.sin(pace * row * 0.02), data.qpos[0]])
            data.ctrl[:] = rows[-1][1]
            mujoco.mj_step(model, data, nstep=40)
        np.savetxt(logs / f"{k}.csv", rows, delimiter=",", header="time,ctrl:hinge_motor,qpos:hinge", comments="")
    (found,) = regression.problems(str(folder / "model.xml"), str(logs))
    return found


def test_baselines_name_what_is_plain_to_see(tmp_path):
    p = problem(tmp_path, 0.2)
    viscous = list(regression.EFFECTS).index("v")
    assert regression.place(p, sindy.terms_of(p)[0]) == ("viscous_friction", "hinge")
    assert viscous in bic.terms_of(p)
    assert regression.least_squares(p, [viscous])[0][0] == pytest.approx(-0.2, rel=0.1)  # a force that brakes
    assert residual.predicted(p, np.random.default_rng(0)) > residual.LEAST


def test_coloured_noise_lasts_and_stamps_jitter():
    plain = Plant(PENDULUM, {})
    run = PENDULUM.record(plain, 0, 0, noise=False)
    off = kinds.coloured(PENDULUM, run, np.random.default_rng(0))
    noise = (off.qpos - run.qpos)[:, 0]
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(np.exp(-0.02 / kinds.COLOUR), abs=0.12)
    assert 0.0005 < np.std(np.diff(off.time)) < 0.003 and (np.diff(off.time) > 0).all()


def test_a_case_is_written_once_and_sealed_and_scored(tmp_path):
    assert kinds.make(PENDULUM, "null", 5, tmp_path) and not kinds.make(PENDULUM, "null", 5, tmp_path)
    (case,) = suite.cases(tmp_path)
    answer = tmp_path / "entries" / "says yes" / case.name
    answer.mkdir(parents=True)
    said = {"verdict": "effects", "effects": [{"name": "backlash", "where": "hinge", "equivalent_to": []}]}
    (answer / "diagnosis.json").write_text(json.dumps(said))
    ended = {"code": 0, "seconds": 1.0, "seal": (case / "seal.txt").read_text()}
    atomic.write_json(answer / "exit.json", ended)
    text, figures = suite.table(tmp_path)
    assert figures["says yes"]["false alarms"]["hits"] == 1 and "| says yes |" in text and "1/1" in text


def test_a_count_is_refused_unless_tree_and_seeds_are_fresh(monkeypatch):
    said = {"status --porcelain": "", "rev-parse HEAD": "new"}
    monkeypatch.setattr(release, "git", lambda *words: said[" ".join(words)])
    counted = [{"commit": "old", "seeds": [2000, 2010]}]
    assert release.refused(range(2010, 2020), counted) == ""
    assert "development" in release.refused(range(1500, 1510), counted)
    assert "has counted" in release.refused(range(2005, 2015), counted)
    said["status --porcelain"] = " M file"
    assert "not committed" in release.refused(range(2010, 2020), counted)


def test_the_table_goes_between_its_marks():
    page = (ROOT / "docs" / "leaderboard.md").read_text()
    new = release.written(page, "| a |")
    assert "| a |" in new and new.count(release.BEGIN) == new.count(release.END) == 1
    assert release.written(new, "| b |") == release.written(page, "| b |")


def test_the_strength_that_is_wanted_is_found_9_times_of_10():
    for truth in calibration.SETTINGS.values():
        curve = calibration.Curve(2.0, truth.slopes[0], truth)
        assert curve.chance(curve.wanted()) == pytest.approx(0.9, abs=1e-6)
    logistic = calibration.Curve(np.log(10), 2.0, calibration.Truth(lapse=0.0))
    assert logistic.wanted() == pytest.approx(10 * 9**0.5)  # logit(0.9) = log 9 over a slope of 2


def test_a_check_of_known_curves_follows_from_its_seed_and_its_plan():
    curves = calibration.drawn(calibration.Truth(effects=3), np.random.default_rng(0))
    trials = calibration.check(curves, 24, 0)
    assert trials == calibration.check(curves, 24, 0) and {t.effect for t in trials} == {"e0", "e1", "e2"}
    assert len(trials) == sum(KINDS[i % len(KINDS)] == "S" for i in range(24))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["as assumed", "steps"])
def test_told_strengths_hold_as_often_as_they_say(name):
    """90 % intervals, within what is asked of them and the error of 20 checks."""
    inside = [np.mean([x[0] for x in calibration.judged(name, seed)]) for seed in range(20)]
    error = np.std(inside, ddof=1) / np.sqrt(len(inside))
    assert 0.85 - 2 * error < np.mean(inside) < 0.97 + 2 * error
