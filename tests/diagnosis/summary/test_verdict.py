"""The name of a verdict, by the posterior of the force that the answer leaves."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence.force_left import ForceLeft
from bayessim_mjx.diagnosis.summary import verdict
from bayessim_mjx.diagnosis.summary.verdict import LIMITS

SENSORS = SimpleNamespace(of_sensors=True)


def force(motion: float, nats: float = 100.0, spread: float = 0.1, noise: float = 1.0) -> ForceLeft:
    """A force that moves so many noise variances, within a share of it."""
    one = np.ones(1)
    return ForceLeft(one, 0.9 * one, 1.1 * one, nats, motion, spread * motion, motion * one, noise)


def verdict_on(
    left: ForceLeft, calibrated=3.0, effects=("x",), coasting=None, nominal=9.0, step=None, delivered=9.0, off=0.0
) -> verdict.Verdict:
    """The verdict on an answer that leaves a force; calibrated, nominal, delivered: rms, in noise standard deviations.

    step: share of the gap that another integrator closes; off: sd by which the only parameter is off.
    """

    class State:
        base = None
        fitter = SimpleNamespace(spread=None)
        nominal = SimpleNamespace(quadratic=lambda: (SimpleNamespace(c=np.array([rms**2])), None))

        def gap(self, model):
            return SimpleNamespace(noise=1.0, after=calibrated**2)

    rms = nominal
    fit = SimpleNamespace(coordinates=(), values=())
    if step is not None:
        known = SimpleNamespace(neutral=1.0, stated=False, precision=1.0, kind="", name="mass")
        fit = SimpleNamespace(coordinates=(known,), values=(1.0 + 0.1 * off,))
    own = SimpleNamespace(mean=np.array(fit.values), covariance=np.array([[0.01]]))
    found = SimpleNamespace(
        model=SimpleNamespace(effects=tuple(SimpleNamespace(coordinates=()) for _ in effects), fit=fit),
        selection=SimpleNamespace(state=State(), ambiguous=False, force=left, estimated=own),
        part=lambda kind: None,
    )
    known_step = {} if step is None else {"share": step}
    far = SimpleNamespace(
        coasting=coasting, calibrated=calibrated, with_effects=1.0, nominal=delivered, integrator=known_step
    )
    return verdict.verdict_of(found, far)


@pytest.fixture(autouse=True)
def sensors(monkeypatch):
    """What is found to be the sensors' noise: nothing, unless a test says so."""
    found = SimpleNamespace(noise=None)
    monkeypatch.setattr(verdict, "sensors_noise", lambda of: found.noise)
    return found


@pytest.mark.parametrize(
    ("share", "name"), [(0.5, "effects"), (0.9, "effects"), (1.1, "effects"), (1.4, "unexplained"), (4, "unexplained")]
)
def test_effects_beside_a_force_that_makes_a_relevant_share_of_the_gap_do_not_explain_it(share, name):
    """In relevant shares of a gap of eight noise variances; 10 % uncertain, so that 1.1 of them may be less."""
    found = verdict_on(force(share * LIMITS.share * 8.0))
    assert found.name == name
    assert found.remains == pytest.approx(share * LIMITS.share if name == "unexplained" else 0.0)


def test_an_uncertain_force_is_no_verdict():
    assert verdict_on(force(2.0, spread=0.1)).name == "unexplained"
    assert verdict_on(force(2.0, spread=1.5)).name == "effects"


def test_a_force_without_evidence_is_no_verdict():
    """Its odds against none have to be strong."""
    assert verdict_on(force(4.0, nats=2.9)).name == "effects"
    assert verdict_on(force(4.0, nats=3.1)).name == "unexplained"


def test_below_a_tenth_of_the_noise_nothing_is_relevant():
    assert verdict_on(force(0.08), calibrated=1.1).name == "effects"


def test_the_gap_is_that_of_joints_that_keep_their_speed_where_these_do_better():
    """30 variances are a twentieth of the simulator's gap, and a third of theirs."""
    assert verdict_on(force(30.0), calibrated=25.0).name == "effects"
    assert verdict_on(force(30.0), calibrated=25.0, coasting=10.0).name == "unexplained"
    assert verdict_on(force(30.0), calibrated=25.0, coasting=90.0).name == "effects"


def test_noise_that_lasts_is_no_force(sensors):
    sensors.noise = SENSORS
    assert verdict_on(force(4.0)).name == "effects"
    assert verdict_on(force(4.0), effects=()).name == "noise"


@pytest.mark.parametrize(
    ("left", "nominal", "name"),
    [
        (force(4.0), 9.0, "unexplained"),
        (force(0.5), 9.0, "parameters"),  # with the noise less than 1.3 standard deviations
        (force(0.5), 1.0, "no_gap"),
        (force(4.0, nats=-5.0), 9.0, "parameters"),
        (force(0.0001, nats=-5.0, noise=2.0), 9.0, "noise"),
    ],
)
def test_names_where_no_effect_is_named(left, nominal, name):
    assert verdict_on(left, calibrated=1.0, effects=(), nominal=nominal).name == name


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"step": 0.9, "off": 1.0}, "no_gap"),  # the time step makes most of the gap, and no parameter is off
        ({"step": 0.9, "off": -3.0}, "parameters"),
        ({"step": 0.2, "off": 1.0}, "parameters"),
        ({"step": 0.0, "off": 3.0, "delivered": 1.0}, "no_gap"),  # the logs are those of the delivered time step
        ({}, "parameters"),
    ],
)
def test_a_gap_of_the_time_step_is_none_of_the_parameters(given, name):
    assert verdict_on(force(0.05), calibrated=1.0, effects=(), nominal=1.4, **given).name == name
