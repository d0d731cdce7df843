"""What a data sheet states, as it is typed; and how such a prior weighs in a fit."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate, base_coordinates
from bayessim_mjx.diagnosis.fitting.fitter import Fit
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


def test_a_models_own_numbers_are_known_to_five_percent(arm):
    every = arm.accuracy
    assert len(every) == len(arm.space) and set(every.values()) == {0.05}
    for c in base_coordinates(arm.space, every):
        assert c.stated and c.precision == pytest.approx(400.0) and c.neutral == 1.0
    (loose, *_) = base_coordinates(arm.space)
    assert not loose.stated and loose.precision == pytest.approx(1 / (0.58 * 0.4) ** 2)


def test_accuracies_by_what_and_by_whose_and_later_ones_win(arm):
    found = data_sheet.accuracies(("10%, mass=2%", "lower=30%"), arm.space, None)
    shares = {p.name: found[p.name] for p in arm.space.parameters}
    for p in arm.space.parameters:
        expected = 0.3 if p.target == "lower" else 0.02 if p.attribute == "mass" else 0.1
        assert shares[p.name] == pytest.approx(expected), p.name
    assert data_sheet.accuracies(("mass=0.02",), arm.space, None).keys() == {
        p.name for p in arm.space.parameters if p.attribute == "mass"
    }


@pytest.mark.parametrize("text", ["weight=5%", "five", "0%", "mass=-2%", "mass="])
def test_accuracies_that_make_no_sense(arm, text):
    with pytest.raises(UserError, match="--accuracy"):
        data_sheet.accuracies((text,), arm.space, None)


def test_a_rating_holds_on_every_body_or_on_one(arm):
    assert data_sheet.rating(("12kg",), arm.mj_model) == {1: 12.0, 2: 12.0}
    assert data_sheet.rating(("lower=3", "5"), arm.mj_model) == {1: 5.0, 2: 3.0}
    assert data_sheet.rated(np.array([0.0, 1.0, 1.0]), {2: 7.0}) == pytest.approx([0.0, 1.0, 7.0])
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
