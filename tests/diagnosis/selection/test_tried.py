"""What models that were tried leave and close, when an effect is there, and where nothing is looked for."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import fits, singles
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Pool
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried


def candidate(effect, where):
    return SimpleNamespace(effect=effect, where=where, label=f"{effect}@{where}", coordinates=())


def fitter_at(step):
    model = SimpleNamespace(opt=SimpleNamespace(timestep=step))
    return SimpleNamespace(simulator=SimpleNamespace(physics=SimpleNamespace(mj_model=model)))


@pytest.mark.parametrize(
    ("value", "unit", "far"), [(1.1, "", 10.0), (0.985, "", 1.5), (1.00021, "s", 0.021), (1.00019, "s", 0.0)]
)
def test_an_effect_is_there_by_how_far_its_amplitudes_are_off_neutral(monkeypatch, value, unit, far):
    """And a lag or delay from a tenth of the simulator's time step on: two integrators differ by less."""
    monkeypatch.setattr(fits, "deviations", lambda fitter, model: np.array([0.3, 0.01, 1e-9]))
    gain, speed = (SimpleNamespace(name=n, neutral=float(n == "gain")) for n in ("gain", "speed"))
    effect = SimpleNamespace(label="effect", coordinates=[gain, speed], shapes=[False, True])  # a shape says nothing
    names = ["mass", "gain", "speed"]
    coordinates = [SimpleNamespace(name=n, unit=u) for n, u in zip(names, ["kg", unit, "rad/s"], strict=True)]
    fit = SimpleNamespace(names=names, values=np.array([1.0, value, 5.0]), coordinates=coordinates)
    model = SimpleNamespace(fit=fit, effects=(effect,))
    assert fits.distances(SimpleNamespace(fitter=fitter_at(0.002)), model) == {"effect": pytest.approx(far)}


@pytest.mark.parametrize(("rms", "believed", "goes_on"), [(1.2, 1.0, False), (1.4, 1.0, True), (1.2, 0.4, True)])
def test_effects_are_added_until_the_sensors_noise_is_reached(rms, believed, goes_on):
    """Where most of what counts as noise is what the time step may be worth, a model with effects can do better."""
    tried = SimpleNamespace(settings=Settings(believed=believed), criteria=Criteria(), noise=50.0)
    cost = np.full(8, 50.0 * rms**2)
    model = SimpleNamespace(effects=(candidate("payload", "link"),), cost=cost, total=cost.sum())
    assert bool(Tried.above_noise(tried, model)) is goes_on
    bare = SimpleNamespace(effects=(), cost=cost, total=cost.sum())
    assert bool(Tried.above_noise(tried, bare)) is (rms > 1.3)


def test_what_is_closed_is_counted_from_the_noise_not_from_the_best_model_tried():
    fitter = SimpleNamespace(size=50.0)
    base, best, lucky, half = (
        Model((), SimpleNamespace(coordinates=()), np.full(8, 50.0 * t), np.full(8, 50.0 * t), np.zeros((8, 0)), 1e4)
        for t in (5, 1, 0.8, 3)
    )
    pool = Pool(fitter, [], Settings(), Criteria(), None, base)
    assert pool.closure(best) == pool.closure(lucky) == 1.0 and pool.closure(base) == 0.0
    assert pool.closure(half) == pytest.approx(0.5)
    assert pool.left(half) == pytest.approx(0.5)


@pytest.mark.parametrize(("level", "fitted"), [(1.2, singles.FEW), (5.0, 7)])
def test_where_nothing_is_wrong_only_a_few_single_effects_are_fitted_for_the_table(monkeypatch, level, fitted):
    """Of ten candidates seven promise something."""
    point = SimpleNamespace(A=np.zeros(0), coordinates=())
    base = Model((), point, np.full(8, 50.0 * level), np.full(8, 50.0 * level), np.zeros((8, 0)), 1e4)
    contact = SimpleNamespace(dist=np.zeros(0))
    physics = SimpleNamespace(template=SimpleNamespace(_impl=SimpleNamespace(contact=contact)))
    fitter = SimpleNamespace(
        base=(), size=50.0, simulator=SimpleNamespace(physics=physics, rollouts=0), begin=lambda base: point,
        iterate=lambda fits, *rest, keep: fits, refresh=lambda fit: fit,
    )  # fmt: skip
    plans = []
    monkeypatch.setattr(singles, "replace", lambda fit, **changes: fit)
    monkeypatch.setattr(singles, "scored", lambda fitter, fit, effects: base)
    monkeypatch.setattr(
        singles,
        "screen",
        lambda *_: [SimpleNamespace(gain=7.0 - i, candidate=SimpleNamespace(label=str(i))) for i in range(10)],
    )
    monkeypatch.setattr(singles, "fit_models", lambda pool, given, *rest: plans.extend(given))
    monkeypatch.setattr(singles, "widen_leading", lambda *_: None)
    seen = []
    pool = singles.begin(fitter, [], Settings(), Criteria(), keep=lambda pool: seen.append(len(pool.screened)))
    singles.fit_singles(pool)
    assert len(plans) == fitted and all(model is base for model, _ in plans)
    assert seen[0] == 0 and pool.models == {frozenset(): base}


def test_single_effects_far_behind_a_fitted_set_are_not_fitted(monkeypatch):
    """What they promise leaves more than `CLOSE` times what the set leaves, but for the first three; alone they are."""
    plans = []
    monkeypatch.setattr(singles, "fit_models", lambda pool, given, *rest: plans.extend(s.gain for _, s in given))
    monkeypatch.setattr(singles, "widen_leading", lambda *_: None)
    some = [SimpleNamespace(gain=g, candidate=SimpleNamespace(label=str(g))) for g in (95.0, 70.0, 55.0, 61.0, 50.0)]
    base, together = SimpleNamespace(total=100.0), SimpleNamespace(total=10.0)
    pool = SimpleNamespace(base=base, models={1: base}, screened=some, settings=Settings(), keep=lambda pool: None)
    pool.above_noise = lambda model: True
    singles.fit_singles(pool)
    assert plans == [95.0, 70.0, 55.0, 61.0, 50.0]
    plans.clear()
    pool.models[2] = together
    singles.fit_singles(pool)
    assert plans == [95.0, 70.0, 55.0, 61.0]


def test_candidates_that_promise_next_to_nothing_beside_the_best_are_not_fitted_alone():
    gains = [100.0, 50.0, 3.0, *[1.9] * 20]
    screened = [SimpleNamespace(gain=g, candidate=SimpleNamespace(label=str(i))) for i, g in enumerate(gains)]
    labels = [s.candidate.label for s in singles.promising(screened, Settings(first=("20",)))]
    assert labels == ["20", *map(str, range(singles.LEAST))]
    all_alike = [SimpleNamespace(gain=5.0, candidate=s.candidate) for s in screened]
    assert len(singles.promising(all_alike, Settings(singles=12))) == 12
