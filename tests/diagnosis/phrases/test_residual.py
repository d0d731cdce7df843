"""Residual forces in words: sentences known beforehand."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.phrases import residual
from tests.diagnosis.phrases.cases import FRICTION, gap, made

UNITS = {"speed": "rad/s", "position": "rad", "direction": "", "time since reversal": "s", "load": "N m"}


def test_of_nested_limits_a_region_has_the_tighter_one():
    assert residual.region([], UNITS) == "everywhere"
    nested = [("speed", False, 0.5), ("direction", True, 0.0), ("speed", False, 0.2)]
    assert residual.region(nested, UNITS) == "speed below 0.2 rad/s, moving forward"
    both = [("position", True, -0.1), ("position", False, 0.4), ("time since reversal", False, 0.05)]
    assert residual.region(both, UNITS) == "position between -0.1 and 0.4 rad, within 0.05 s after a reversal"
    assert residual.region([("load", True, 1.0), ("load", True, 2.0)], UNITS) == "gravity load above 2 N m"


def test_a_sign_stands_in_the_words_where_they_have_a_place_for_it():
    linear = residual.SIGNATURES["odd and even in speed"].terms["linear"]
    assert residual.signed(-0.3, -0.4, -0.2, "N m/(rad/s)", linear) == (
        "0.3 [0.2, 0.4] N m/(rad/s) with the motion, linear in speed"
    )
    assert residual.signed(-0.3, -0.4, -0.2, "s", "times the speed") == "-0.3 [-0.4, -0.2] s times the speed"
    assert residual.missing_force(-0.06, "N m", along=True) == "0.06 N m against the motion"
    assert residual.missing_force(-0.06, "N m", along=False) == "-0.06 N m"


def test_a_flexible_force_removes_a_share_of_the_residual_above_the_noise():
    """Windows of 50 residuals: 5 noise variances of which 3 go are three quarters of 4; 1.3 of them are the noise."""

    def held(variances, gain):
        return SimpleNamespace(significant=True, base=np.full(8, 50.0 * variances), gain=8 * 50.0 * gain)

    depends = [{"input": "the speed of elbow", "importance": 1.0}]
    found = SimpleNamespace(condition=held(5.0, 3.0), samples=50, where={"elbow": 1.0}, depends_on=depends)
    found.interpolation = held(1.3, 0.2)
    first, second = residual.flexible(residual.flexible_of(found, "effects"))
    assert first == "Held out by condition, a flexible force removes 75 % of the squared residual with the effects."
    assert second == "This force acts at elbow and depends on the speed of elbow."
    found.condition = held(1.3, 0.2)
    (text,) = residual.flexible(residual.flexible_of(found, "recalibrated"))
    assert text.startswith("The residual of the recalibrated simulator") and "within the measurement noise" in text


@pytest.mark.parametrize(
    ("rms", "said"),
    [
        (1.0, "closes 3.0 % of the squared gap above the noise. Relevant is more than 10 %"),
        (None, ""),
    ],
)
def test_a_flexible_force_that_closes_little_beside_the_effects_is_no_missing_cause(rms, said):
    """From 2 to 1 noise sd, of 10: 3 of the 99 above the noise, in squares."""
    details = {"flexible": {"rms_on_winner": rms}, "force_left": {"relevant_share": 0.1}}
    found = made("effects", [FRICTION], gap(calibrated=10.0, with_effects=2.0), details=details)
    assert said in residual.beside_effects(found) and "remains" not in residual.beside_effects(found)
    large = dataclasses.replace(found, gap=gap(calibrated=10.0, with_effects=5.0))
    assert ("a cause without a name remains" in residual.beside_effects(large)) == (rms is not None)
