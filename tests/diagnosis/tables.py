"""Races whose models are not fitted: how well each predicts is looked up in a table."""

from types import SimpleNamespace

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.selection import race, search, verdict
from bayessim_mjx.diagnosis.selection.models import Model

NOISE, WINDOWS = 50.0, 8


def law(effect, where="hinge", numbers=1, places=None):
    """A candidate of so many amplitudes; laws of one effect at the same place have the same numbers."""
    names = [f"{effect}@{where}.{i}" for i in range(numbers)]
    index = tuple(f"{effect}@{place}" for place in places or (where,))
    coordinates = tuple(SimpleNamespace(name=name, neutral=0.0, index=index) for name in names)
    return Candidate(effect, where, "joint", coordinates, (False,) * numbers)


class Table:
    """Squared errors in noises by sets of laws; what is not listed predicts like the best of its parts."""

    def __init__(self, monkeypatch, errors, settings=None):
        self.errors = {frozenset(laws): error for laws, error in errors.items()}
        self.laws = list(dict.fromkeys(c for laws in errors for c in laws))
        windows = SimpleNamespace(group=np.arange(WINDOWS))
        physics = SimpleNamespace(template=SimpleNamespace(_impl=SimpleNamespace(contact=SimpleNamespace(dist=()))))
        physics.template._impl.contact.dist = np.zeros(0)
        fitter = SimpleNamespace(size=NOISE, simulator=SimpleNamespace(windows=windows, physics=physics))
        base = self.model(())
        self.race = race.Race(fitter, self.laws, settings or race.Settings(), None, base, base)
        self.race.models[frozenset()] = base
        self.race.screened = self.screen(None, None, self.laws, 0)
        for module in (race, search, verdict):
            for name, instead in (("fit_models", self.fit), ("polish", lambda race, m: m), ("screen", self.screen)):
                monkeypatch.setattr(module, name, instead, raising=False)
        monkeypatch.setattr(race, "deviations", lambda fitter, model: np.full(len(model.fit.names), 0.1))

    def model(self, effects):
        error = min(value for laws, value in self.errors.items() if laws <= set(effects))
        coordinates = [c for effect in effects for c in effect.coordinates]
        names, values = [c.name for c in coordinates], np.ones(len(coordinates))
        fit = SimpleNamespace(coordinates=coordinates, names=names, values=values)
        cost = NOISE * error * (1 + 0.01 * np.cos(np.arange(WINDOWS)))
        return Model(tuple(effects), fit, cost, np.zeros((WINDOWS, len(names))), 1e4)

    def fit(self, race, plans, label, say):
        models = [self.model((*model.effects, extra.candidate)) for model, extra in plans]
        race.models.update({frozenset(c.label for c in m.effects): m for m in models})
        return models

    @staticmethod
    def screen(fitter, fit, candidates, screened):
        return [SimpleNamespace(candidate=c, start=None, gain=1.0, absorbed=0.0, column=None) for c in candidates]

    def tried(self, *singles):
        """The race after the fits of single laws (all by default)."""
        base = self.race.base
        self.fit(self.race, [(base, s) for s in self.race.screened if s.candidate in (singles or self.laws)], "", None)
        return self.race
