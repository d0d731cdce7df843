"""What the search fits next: plans belong to a fit, and lateness may stand for lateness."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from scipy.special import ndtr

from bayessim_mjx.diagnosis.evidence import search
from bayessim_mjx.diagnosis.evidence.laws import same_lateness
from bayessim_mjx.diagnosis.evidence.weighing import _spread

TWO = """
<mujoco>
  <worldbody>
    <body><joint name="shoulder"/><geom size=".1"/><body><joint name="elbow"/><geom size=".1"/></body></body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
</mujoco>
"""


def law(effect: str, kind: str, where: str) -> SimpleNamespace:
    return SimpleNamespace(effect=effect, kind=kind, where=where)


def test_a_delay_may_be_a_lag_or_a_filter_of_the_same_joint_and_of_no_other():
    model = mujoco.MjModel.from_xml_string(TWO)
    delay = law("actuator_delay", "actuator", "m1")
    assert same_lateness(law("sensor_filter", "joint", "shoulder"), delay, model)
    assert same_lateness(law("actuator_lag", "actuator", "m1"), delay, model)
    assert not same_lateness(law("sensor_filter", "joint", "elbow"), delay, model)
    assert not same_lateness(law("actuator_lag", "actuator", "m2"), delay, model)
    assert not same_lateness(law("coulomb_friction", "joint", "shoulder"), delay, model)
    assert not same_lateness(delay, delay, model)


def test_plans_around_a_set_are_made_anew_where_its_fit_has_gained(monkeypatch):
    total, made = [10.0], []
    monkeypatch.setattr(search, "around", lambda weighing, key, say: made.append(weighing.total(key)) or [len(made)])
    own = search.Search.__new__(search.Search)
    own.weighing, own.say, own._plans = SimpleNamespace(total=lambda key: total[0]), None, {}
    key = frozenset({"a"})
    assert own._around(key) == [1] and own._around(key) == [1]
    total[0] = 10.5
    assert own._around(key) == [1]  # half a nat
    total[0] = 188.0
    assert own._around(key) == [2] and made == [10.0, 188.0]


def test_no_plan_puts_a_law_in_that_the_set_has(monkeypatch):
    """A payload and the inertia of its body may stand for each other, but not where both are in the set."""
    every = [law(effect, "body", "arm") for effect in ("payload", "inertial_parameters", "coulomb_friction")]
    for one in every:
        one.label = one.effect
    monkeypatch.setattr(search, "inertia", lambda c, effect: "coulomb_friction" not in (c.label, effect.label))
    monkeypatch.setattr(search, "related", lambda c, effect: False)
    monkeypatch.setattr(search, "same_lateness", lambda c, effect, model: False)
    own = search.Search.__new__(search.Search)
    own._again, own._begun = set(), lambda model, effect, c: ((), ())
    fitter = SimpleNamespace(simulator=SimpleNamespace(physics=SimpleNamespace(mj_model=None)))
    for effects in (every[:1], every[:2]):
        key = frozenset(e.label for e in effects)
        models = {k: SimpleNamespace(effects=effects) for k in (key, *(key - {x} for x in key))}
        secants = SimpleNamespace(of=lambda some: list(some))
        own.state = SimpleNamespace(models=models, candidates=every, secants=secants, fitter=fitter)
        assert [p.columns[0].label for p in own._related(key)] == ["inertial_parameters"] * (len(effects) == 1)


@pytest.mark.parametrize("far", [0.05, 0.2, 0.4])
def test_intervals_hold_90_percent_of_the_mixture_over_sets(far):
    share, away = np.array([1 - far, far]), np.array([[0.0, 0.0], [-0.8, 0.0]])
    sd = np.array([[0.01, 0.3], [0.05, 0.3]])
    found = _spread(share, away, sd)
    half = 1.645 * found
    inside = sum(w * (ndtr((half - m) / s) - ndtr((-half - m) / s)) for w, m, s in zip(share, away, sd, strict=True))
    assert np.all(inside > 0.8995)
    assert found[1] == pytest.approx(0.3, rel=1e-3)  # both sets agree: a Gaussian's own
    assert found[0] >= np.sqrt(share @ (sd[:, 0] ** 2 + away[:, 0] ** 2)) - 1e-12
