"""What is said of a named effect's parameters besides their numbers."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from bayessim_mjx.diagnosis.evidence.selecting import Size
from bayessim_mjx.diagnosis.summary import estimates


@pytest.mark.parametrize(
    ("deviation", "sentence"), [(2.0, "To previous is not identified by these logs."), (0.5, ""), (0.001, "")]
)
def test_a_share_that_reaches_no_joint_is_said_to_be_unidentified(monkeypatch, deviation, sentence):
    """A drive at the end of a chain has one neighbour; ranges are from -1 to 1."""
    names = ("waist.effort_coupling.to_next", "waist.effort_coupling.to_previous")
    coordinates = [SimpleNamespace(name=n, low=-1.0, high=1.0, unit="", neutral=0.0) for n in names]
    shapes = np.zeros(2, bool)
    effect = SimpleNamespace(effect="effort_coupling", where="waist", coordinates=coordinates, label="x", shapes=shapes)
    fit = SimpleNamespace(names=list(names), values=np.array([-0.027, 0.0]), coordinates=coordinates)
    model = SimpleNamespace(fit=fit, effects=(effect,))
    fitter = SimpleNamespace(simulator=SimpleNamespace(windows=SimpleNamespace(dt=0.01)))
    setup = SimpleNamespace(physics=None, fitter=fitter)
    found = SimpleNamespace(setup=setup, model=model, selection=SimpleNamespace(rivals={}))
    monkeypatch.setattr(estimates.bounds, "of", lambda physics, coordinate, value: None)
    monkeypatch.setattr(estimates, "_unit", lambda setup, effect, unit: unit)
    part = {"share": 1.0, "gap_closed": 1.0, "gap_closed_ci": (0.9, 1.0), "predicted_gap_closed": 1.0}
    found_ = estimates._effect(found, effect, np.array([0.003, deviation]), part)
    assert found_.sentence == sentence
    assert found_.parameters["to_previous"].sd == deviation


def test_rivals_of_one_unit_share_a_size():
    """A delay of 10 +- 1 ms, of two thirds, and a filter of 13 +- 1 ms: the mixture's mean and 90 % interval."""
    effect = SimpleNamespace(label="delay@motor", shapes=np.zeros(1, bool))
    own = Size("delay", 0.010, 0.001, "s")

    def rival(label, size):
        return SimpleNamespace(effects=[SimpleNamespace(label=label)], size=size)

    rivals = [
        rival("filter@hinge", Size("time_constant", 0.013, 0.001, "s")),
        rival("bias@motor", Size("bias", 1, 1, "N m")),
    ]
    shared = estimates._shared(effect, own, rivals, [0.5, 0.25, 0.25])
    assert shared["effects"] == ["delay@motor", "filter@hinge"] and shared["unit"] == "s"
    assert shared["mean"] == pytest.approx(0.011)
    below = [
        2 / 3 * norm.cdf(x, 0.010, 0.001) + 1 / 3 * norm.cdf(x, 0.013, 0.001) for x in (shared["low"], shared["high"])
    ]
    assert below == pytest.approx([0.05, 0.95], abs=1e-6)
    assert estimates._shared(effect, own, rivals[1:], [0.7, 0.3]) == {}


@pytest.mark.parametrize(("conditions", "chosen", "nested"), [(1, 5, False), (2, 2, False), (3, 3, True)])
def test_a_choice_is_nested_from_three_conditions_on_and_never_within_one_log(conditions, chosen, nested):
    """Of one log five blocks are held out, which are no conditions."""
    cut = SimpleNamespace(conditions=conditions)
    found = SimpleNamespace(
        selection=SimpleNamespace(chosen=dict.fromkeys(range(chosen), frozenset()), elsewhere=0.9),
        setup=SimpleNamespace(fitter=SimpleNamespace(simulator=SimpleNamespace(windows=cut))),
    )
    assert estimates.nested(found) == nested
