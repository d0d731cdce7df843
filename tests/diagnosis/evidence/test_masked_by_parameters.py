"""Effects that a known parameter far from the data sheet may stand for: one law, by its motion and by the prior."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_t

from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.data_sheet import ACCURACY, SURE
from bayessim_mjx.diagnosis.evidence import laws
from bayessim_mjx.diagnosis.evidence.parameters import unlikely
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from tests.diagnosis import pendulums

KNOWN = Coordinate("own", (), 1.0, 0.1, 3.0, 1 / ACCURACY**2, "", stated=True)


def fit_of(kinds: str, values: list[float]) -> Fit:
    coordinates = tuple(replace(KNOWN, name=f"p{i}", kind=k.strip()) for i, k in enumerate(kinds))
    empty = np.zeros((1, 1, len(values)))
    return Fit(coordinates, np.array(values), np.zeros((1, 1)), np.zeros((1, 1)), empty, empty, np.ones(1), 0.0)


def test_a_kind_is_a_multivariate_student_t_and_a_stated_parameter_a_gaussian():
    fit = fit_of("aa ", [1.1, 0.8, 1.2])
    away = fit.values - 1.0
    t = multivariate_t(np.zeros(2), ACCURACY**2 * np.eye(2), df=SURE)
    expected = t.logpdf([0, 0]) - t.logpdf(away[:2]) + 0.5 * (0.2 / ACCURACY) ** 2
    assert unlikely(fit.coordinates, away) == pytest.approx(expected)


def work(room: tuple[float, float]) -> tuple[SimpleNamespace, np.ndarray]:
    return SimpleNamespace(room=room, at=lambda amount: np.array([amount])), np.array([0.0, 1.0])


def test_the_best_amount_takes_the_whole_deviation_back_and_the_range_bounds_it():
    fit = fit_of("ab", [1.0, 1.5])
    away = fit.values - 1.0
    whole = laws._gain(fit, away, *work((-1.0, 1.0)))
    assert whole.nats == pytest.approx(unlikely(fit.coordinates, away))
    np.testing.assert_allclose(whole.steps, [0.0, 0.5])
    half = laws._gain(fit, away, *work((-1.0, 0.25)))
    np.testing.assert_allclose(half.steps, [0.0, 0.25])
    assert 0 < half.nats < whole.nats
    wrong = laws._gain(fit, away, *work((-1.0, 0.0)))
    assert wrong.nats == 0.0


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(("damping", "expected"), [(1.9, ["viscous_friction@hinge"]), (1.03, [])])
def test_a_damping_far_from_the_data_sheet_may_be_viscous_friction(tmp_path, damping, expected):
    logs = pendulums.recorded(scale=(damping, 0.98, 1.02), count=6)
    robot = pendulums.nominal(tmp_path)
    found = run.diagnose(robot, logs, effects=["viscous_friction", "coulomb_friction"], verdict_only=True)
    assert found.verdict in ("parameters", "no_gap") and not found.effects
    same = {name: own["same_as"] for name, own in found.parameters.items()}
    assert same == {name: expected if "damping" in name else [] for name in same}
    assert any("viscous friction" in text and "--accuracy" in text for text in found.sentences) == bool(expected)
