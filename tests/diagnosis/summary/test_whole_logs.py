"""The longest horizon: at its beginning the windows' own simulation; honest where nothing is predictable."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.request import Request, Tolerance
from bayessim_mjx.diagnosis.summary import again, assemble
from tests.diagnosis import pendulums
from tests.diagnosis.pendulums import PERIOD, nominal, recorded

pytestmark = pytest.mark.slow  # whole diagnoses; CI runs those of one of them

EFFECTS = ("coulomb_friction", "viscous_friction")


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory):
    logs = recorded(friction=0.04, scale=(0.9, 1.1, 0.95), count=4, seconds=2.4)
    needed = [s for s in run.STAGES if not s.optional]
    return run.investigate(nominal(tmp_path_factory.mktemp("rubbing")), logs, Request(EFFECTS), stages=needed)


@pytest.mark.ci
def test_a_log_begins_as_its_first_window(rubbing):
    cut = rubbing.setup.fitter.simulator.windows
    stages = ("nominal", "with_effects")
    first = int(np.flatnonzero(cut.log == 2)[0])
    chains = again._chains(rubbing.setup, np.array([2]), [int(cut.start[first])], 3 * cut.steps)
    (rows,) = again._simulated(rubbing, chains, stages, [first])
    for row, stage in zip(rows, stages, strict=False):
        np.testing.assert_allclose(row[: cut.steps], rubbing.predictions[stage].error[first], atol=0.05)


@pytest.mark.ci
def test_whole_logs_are_the_third_horizon(rubbing):
    diagnosis = assemble.diagnosis_of(rubbing)
    short, window, log = diagnosis.gap.horizons
    assert short["seconds"] < window["seconds"] == pytest.approx(0.5) and log["seconds"] == pytest.approx(2.4, abs=0.1)
    assert log["name"] == "whole log"
    assert log["nominal"] > log["with_effects"] and log["calibrated"] > 2 * log["with_effects"]
    assert log["with_effects"] >= log["reducible_floor"] >= 1.0
    for row in diagnosis.gap.horizons:
        for stage, (low, high) in row["ci"].items():
            assert low <= row[stage] * 1.01 and row[stage] <= high * 1.01, (row["name"], stage)
    assert diagnosis.gap.nominal == window["nominal"]
    assert log["over_likely"] < 1.5  # the law is right


@pytest.mark.ci
def test_each_log_has_draws_of_its_own(rubbing):
    """Common draws of the parameters would let one of them stand for all logs."""
    cut, law = rubbing.setup.fitter.simulator.windows, 0.1 * np.eye(len(rubbing.model.fit.values))
    away = []
    for w in (int(np.flatnonzero(cut.log == log)[0]) for log in range(3)):
        thetas, _ = again._drawn(rubbing, ["with_effects"], law, w)
        away.append(thetas[-again.SEVERAL :] - thetas[0])
    assert np.ptp(away[0], axis=0).max() > 0
    assert not np.allclose(away[0], away[1], rtol=0.01) and not np.allclose(away[1], away[2], rtol=0.01)


def test_what_is_likely_is_noise_and_what_draws_leave_of_the_mean():
    error, likely = np.full((10, 2), 3.0), np.full((4, 10, 2), 2.0)
    assert again.beyond(error, likely) == pytest.approx(9 / (1 + 4))
    likely[0, 3] = np.nan  # a draw that diverged
    assert again.beyond(error, likely) == pytest.approx(9 / (1 + 4))


@pytest.mark.slow
def test_an_unstable_motion_counts_as_long_as_it_can_be_predicted(tmp_path, monkeypatch):
    upside_down = pendulums.MODEL.replace("<option ", '<option gravity="0 0 9.81" ')
    monkeypatch.setattr(pendulums, "MODEL", upside_down)  # held upright by its controller; open loop it falls
    found = run.investigate(nominal(tmp_path), recorded(friction=0.04, count=4, seconds=3.0), Request(EFFECTS[:1]))
    over = again.whole_logs(found)
    assert "unstable or chaotic motion: in 4 of 4 logs" in over.notes[0]
    assert over.seconds < 2.5 and (over.name.startswith("up to") or not len(over.group))


@pytest.mark.ci
def test_the_start_s_uncertainty_decides_how_long():
    """Until it exceeds the tolerance of .1 rad, a hundred noises; a motion that is no longer finite ends there."""
    one = np.ones(1)
    allowed = Tolerance(("hinge",), ("rad",), 0.1 * one, one, 1e-3 * one, one > 0)
    grows = np.exp(5.0 * PERIOD * np.arange(200))  # in noises, 5/s
    steps = again.predictable(np.repeat(grows[None, :, None], 4, 0), allowed)
    assert steps * PERIOD == pytest.approx(np.log(100) / 5.0, abs=PERIOD)
    assert again.predictable(np.full((4, 200, 1), 10.0), allowed) == 200
    assert again.predictable(np.where(np.arange(200) < 50, 0.0, np.nan)[None, :, None], allowed) == 50
