"""Which of several explanations is named, and which are told beside it, on races made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import race as races
from bayessim_mjx.diagnosis.selection import verdict
from bayessim_mjx.diagnosis.selection.models import Model
from tests.diagnosis.tables import Table, law


def candidate(effect, where):
    return SimpleNamespace(effect=effect, where=where, label=f"{effect}@{where}", coordinates=())


@pytest.mark.parametrize(
    ("alone", "effect", "named"),
    [
        (1.2, "armature", "pole"),
        (1.3, "armature", "all"),  # 400 nats: the logs tell
        (1.2, "payload", "all"),  # another law
    ],
)
def test_one_place_is_named_before_all_where_the_logs_cannot_tell(monkeypatch, alone, effect, named):
    tied, one = law("armature", "all", places=("pole", "cart")), law(effect, "pole")
    table = Table(monkeypatch, {(): 100, (tied,): 1.2, (one,): alone})
    race = table.tried()
    race.winner = table.model((tied,))
    verdict.rule(race, lambda *_: None)
    assert [e.where for e in race.winner.effects] == [named]


def test_one_law_in_the_place_of_two_is_told_of_both(monkeypatch):
    """Friction that differs by direction is dry friction and a bias: 17 +- 16 mN m are 33 and 1 mN m."""
    dry, bias, both = law("coulomb_friction"), law("actuator_bias"), law("asymmetric_friction", numbers=2)
    table = Table(monkeypatch, {(): 100, (dry,): 40, (bias,): 60, (both,): 1.0, (dry, bias): 1.0})
    race = table.tried()
    race.winner = table.model((dry, bias))
    ruling = verdict.rule(race, lambda *_: None)
    assert set(race.winner.effects) == {dry, bias}
    for effect in (dry, bias):
        (found,) = [r for r in ruling.rivals[effect.label] if r.model.effects == (both,)]
        assert found.contains and found.closure == pytest.approx(1.0, abs=1e-3)
    assert not any(r.effects == (bias,) for r in ruling.rivals[dry.label])


@pytest.mark.parametrize(("value", "far", "there"), [(1.1, 2.0, True), (1.015, 2.0, False), (1.015, 1.0, True)])
def test_an_effect_is_there_when_an_amplitude_is_off_neutral(monkeypatch, value, far, there):
    monkeypatch.setattr(races, "deviations", lambda fitter, model: np.array([0.3, 0.01, 1e-9]))
    gain, speed = SimpleNamespace(name="gain", neutral=1.0), SimpleNamespace(name="speed", neutral=0.0)
    effect = SimpleNamespace(coordinates=[gain, speed], shapes=[False, True])  # a shape says nothing
    fit = SimpleNamespace(names=["mass", "gain", "speed"], values=np.array([1.0, value, 5.0]))
    race = SimpleNamespace(fitter=None)
    assert races.Race.distinct(race, SimpleNamespace(fit=fit), effect, far) is there


@pytest.mark.parametrize(("rms", "believed", "goes_on"), [(1.2, 1.0, False), (1.4, 1.0, True), (1.2, 0.4, True)])
def test_effects_are_added_until_the_sensors_noise_is_reached(rms, believed, goes_on):
    """Where most of what counts as noise is what the time step may be worth, a model with effects can do better."""
    race = SimpleNamespace(settings=races.Settings(believed=believed), noise=50.0)
    cost = np.full(8, 50.0 * rms**2)
    model = SimpleNamespace(effects=(candidate("payload", "link"),), cost=cost, total=cost.sum())
    assert bool(races.Race.above_noise(race, model)) is goes_on
    bare = SimpleNamespace(effects=(), cost=cost, total=cost.sum())
    assert bool(races.Race.above_noise(race, bare)) is (rms > 1.3)


def raced(*totals, noise=50.0, settings=None):
    """A race whose first model is the base and whose second the winner; `totals` are costs per window / noise."""
    windows = SimpleNamespace(group=np.arange(8))
    fitter = SimpleNamespace(size=noise, simulator=SimpleNamespace(windows=windows))
    effects = [(), *((candidate("payload", f"link{i}"),) for i in range(1, len(totals)))]
    models = [
        Model(e, SimpleNamespace(coordinates=()), np.full(8, noise * t), np.zeros((8, 0)), 1e4)
        for e, t in zip(effects, totals, strict=True)
    ]
    race = races.Race(fitter, [], settings or races.Settings(), None, models[0], models[1])
    race.models = {frozenset(e.label for e in m.effects): m for m in models}
    return race, models


def test_what_is_closed_is_counted_from_the_noise_not_from_the_best_model_tried():
    race, (base, winner, lucky, half) = raced(5.0, 1.0, 0.8, 3.0)
    assert race.closure(winner) == race.closure(lucky) == 1.0 and race.closure(base) == 0.0
    assert race.closure(half) == pytest.approx(0.5)
    assert race.left(half) == pytest.approx(0.5)


@pytest.mark.parametrize(("rms", "misfit"), [(1.2, False), (1.4, True)])
def test_a_model_misfits_beyond_the_same_noise_floor_at_which_the_race_goes_on(rms, misfit):
    """Clearly worse held out, yet close behind: still a rival where neither law fits well, and only there."""
    race, (_, winner, other) = raced(50.0, rms**2, rms**2 + 0.5)
    assert bool(race.above_noise(winner)) is misfit
    effect, effects = winner.effects[0], other.effects
    assert bool(verdict._rival(race, winner, effect, effects, other)) is misfit
