"""What a data sheet states, as it is typed; and how such a prior weighs in a fit."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.diagnosis.data_sheet import SURE
from bayessim_mjx.diagnosis.evidence import parameters
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate, base_coordinates
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.summary import estimates
from bayessim_mjx.errors import UserError

ARM = """<mujoco><worldbody><body name="upper"><joint name="shoulder" damping="1"/><geom size=".1" mass="2"/>
<body name="lower" pos="1 0 0"><joint name="elbow" damping="1"/><geom size=".1" mass="1"/></body></body></worldbody>
<actuator><motor joint="shoulder"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def arm():
    return robot.robot_of(mujoco.MjModel.from_xml_string(ARM))


def of(arm, *texts):
    names = {n: n.rsplit(".", 1)[-1] for n in arm.space.names}
    return {names[n]: s for n, s in data_sheet.accuracies(texts, arm.space, 0.05).items()}


def test_a_models_own_numbers_count_as_a_data_sheets(arm):
    every = arm.accuracy
    assert len(every) == len(arm.space) and set(every.values()) == {data_sheet.ACCURACY}
    for c in base_coordinates(arm.space, every):
        assert c.stated and c.precision == pytest.approx(data_sheet.ACCURACY**-2) and c.neutral == 1.0
    (loose, *_) = base_coordinates(arm.space)
    assert not loose.stated and loose.precision == pytest.approx(1 / (0.58 * (loose.high - loose.low)) ** 2)


def test_a_stated_number_stays_within_four_standard_deviations(arm):
    shares = data_sheet.accuracies(("5%, lower=30%",), arm.space, None)
    for c, p in zip(base_coordinates(arm.space, shares), arm.space.parameters, strict=True):
        assert (c.low, c.high) == pytest.approx((0.3, 2.0) if p.target == "lower" else (0.8, 1.2))
    wide = base_coordinates(arm.space, arm.accuracy, arm.assumed)
    assert all((c.low, c.high) == pytest.approx((0.3, 2.0)) for c in wide)  # nobody stated it


def test_ranges_hold_the_errors_of_the_least_accurate_data_sheet(arm):
    for c in base_coordinates(arm.space):
        assert c.low <= 1 - 2.32 * data_sheet.WORST and c.high >= 1 + 2.32 * data_sheet.WORST


def test_accuracies_by_what_and_by_whose_and_later_ones_win(arm):
    found = data_sheet.accuracies(("10%, mass=2%", "lower=30%"), arm.space, None)
    shares = {p.name: found[p.name] for p in arm.space.parameters}
    for p in arm.space.parameters:
        expected = 0.3 if p.target == "lower" else 0.02 if p.attribute == "mass" else 0.1
        assert shares[p.name] == pytest.approx(expected), p.name
    assert data_sheet.accuracies(("mass=0.02",), arm.space, None).keys() == {
        p.name for p in arm.space.parameters if p.attribute == "mass"
    }


@pytest.mark.parametrize("text", ["weight=5%", "five", "5", "mass=2", "0%", "mass=-2%", "mass="])
def test_accuracies_that_make_no_sense(arm, text):
    with pytest.raises(UserError, match="--accuracy"):
        data_sheet.accuracies((text,), arm.space, None)


def test_a_rating_holds_on_every_body_or_on_one(arm):
    assert data_sheet.rating(("12kg",), arm.mj_model) == {1: 12.0, 2: 12.0}
    assert data_sheet.rating(("lower=3", "5"), arm.mj_model) == {1: 5.0, 2: 3.0}
    for text in ("hand=3", "heavy", "lower=-1kg"):
        with pytest.raises(UserError, match="--payload"):
            data_sheet.rating((text,), arm.mj_model)


def test_stated_priors_weigh_as_the_misfit_says():
    pair = [Coordinate(n, (i,), 1.0, 0.5, 1.5, 400.0, stated=n == "a") for i, n in enumerate("ab")]
    empty = np.zeros((1, 1))
    fit = Fit(
        tuple(pair), np.array([1.05, 1.05]), empty, empty, np.zeros((1, 1, 2)), empty[:, :, None], np.ones(1), 0.0
    )
    wrong = dataclasses.replace(fit, doubt=9.0)
    assert wrong.prior()[0] == pytest.approx([3600.0, 400.0]) and wrong.belief() == pytest.approx([400.0, 400.0])
    assert wrong.prior()[1] == pytest.approx([-180.0, -20.0])
    assert fit.penalty(fit.values, stated=True) == pytest.approx(1.0) == fit.penalty(fit.values)


def assumed_fit(off, own=3, stated=1.3):
    """Parameters of a kind, each so far off its value of 1; one of another kind; one that is stated and far off."""
    kinds = ["mass"] * own + ["damping", ""]
    every = [Coordinate(str(i), (i,), 1.0, 0.3, 2.0, 400.0, stated=True, kind=k) for i, k in enumerate(kinds)]
    values = np.array([1.0 + off] * own + [1.02, stated])
    blank = np.zeros((1, 1, own + 2))
    return Fit(tuple(every), values, blank[0], blank[0], blank, blank[:, :, :1], np.ones(1), 0.0)


def test_an_assumed_accuracy_gives_way_where_parameters_of_a_kind_lie_farther_off_together():
    near, far = assumed_fit(0.05), assumed_fit(0.2)
    assert near.trust() == pytest.approx(np.ones(5))
    assert near.penalty(near.values, stated=True) == pytest.approx(3 + 0.16 + 36)
    share = (SURE + 3) / (SURE + 48)
    assert far.trust() == pytest.approx([share] * 3 + [1.0, 1.0])  # of one kind alone
    assert far.belief() == pytest.approx([400 * share] * 3 + [400, 400])  # what is stated stays as it is
    assert far.penalty(far.values, stated=True) == pytest.approx(3 - (SURE + 3) * np.log(share) + 0.16 + 36)


@pytest.mark.parametrize("off", [0.02, 0.0501, 0.1, 0.25])
def test_the_pull_of_a_prior_is_the_slope_of_its_penalty(off):
    fit, h = assumed_fit(off), 1e-6
    for i in range(5):
        step = np.eye(5)[i] * h
        sides = [fit.penalty(fit.values + sign * step, stated=True) for sign in (1, -1)]
        assert fit.prior()[1][i] == pytest.approx(-0.5 * (sides[0] - sides[1]) / (2 * h), rel=1e-4)


def test_an_accuracy_is_assumed_where_nobody_states_one(arm, tmp_path):
    assert arm.assumed == set(arm.space.names)
    masses = {p.name for p in arm.space.parameters if p.attribute == "mass"}
    assert arm.stated(("mass=2%",)).assumed == arm.assumed - masses
    assert not arm.stated(("10%",)).assumed
    own = {c.name: c.kind for c in base_coordinates(arm.space, arm.accuracy, arm.assumed) if c.kind}
    assert own == {p.name: p.attribute for p in arm.space.parameters}
    assert not any(c.kind for c in base_coordinates(arm.space, arm.accuracy))


def test_a_result_warns_where_the_model_is_less_accurate_than_usual():
    def of(off):
        fit = assumed_fit(off)
        sheet = parameters.posterior(fit, 1e6 * np.eye(5))
        model = SimpleNamespace(fit=fit)
        return estimates.accuracy(model, sheet), estimates.less_accurate(model, sheet)

    numbers, said = of(0.02)
    assert said == [] and numbers["mass"]["parameters"] == 3 and numbers["mass"]["high"] < numbers["damping"]["high"]
    numbers, (text,) = of(0.3)
    assert numbers["mass"]["low"] < 0.3 < numbers["mass"]["high"]
    assert "mass about" in text and "damping" not in text and "--accuracy" in text
