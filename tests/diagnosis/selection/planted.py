"""A diagnosis without simulation: effects are columns, the gap a planted sum of some of them, fits least squares."""

import numpy as np

from bayessim_mjx.diagnosis.selection import dense
from bayessim_mjx.diagnosis.selection.table import BASE, SPREADS, Law, Row, Table

CONDITIONS, WINDOWS, ROWS = 5, 8, 40


def law(effect, where="hinge", numbers=1, places=None, special=(), kind="", spread=None):
    """A candidate; laws of one effect at the same place have the same numbers."""
    index = frozenset(f"{effect}@{place}" for place in places or (where,))
    spread = kind in SPREADS if spread is None else spread
    return Law(f"{effect}@{where}", effect, where, numbers, index, special, kind, spread)


def table(errors, noise=50.0, believed=1.0, group=None, samples=1e4, tolerated=0.0):
    """A table of {laws: squared error in noises, or one for each window}."""
    group = np.arange(8) if group is None else group
    laws = {c.label: c for key in errors for c in key}
    rows = {}
    for key, error in errors.items():
        cost = noise * np.broadcast_to(error, len(group)) * (1 + 0.01 * np.cos(np.arange(len(group))))
        labels = frozenset(c.label for c in key)
        distance = dict.fromkeys(labels, 100.0)
        rows[labels] = Row(labels, 3 + sum(c.numbers for c in key), cost, samples, distance)
    return Table(rows, laws, group, noise, believed, tolerated=tolerated)


class Linear:
    """What the search asks for, answered by least squares on planted columns with conditions held out in turn.

    Args:
        columns: {label: `[CONDITIONS * WINDOWS * ROWS]`}; amounts: {label: what is planted}.
        kind: of all places; places: those that "all" ties together.
    """

    def __init__(self, columns, amounts, seed=0, kind="", places=()):
        rng = np.random.default_rng(1000 + seed)
        self.names = list(columns)
        self.X = np.stack([columns[name] for name in self.names], 1)
        self.y = sum(a * columns[name] for name, a in amounts.items()) + rng.normal(size=len(self.X))
        self.laws = {}
        for name in self.names:
            effect, _, where = name.partition("@")
            self.laws[name] = law(effect, where, places=places if where == "all" else None, kind=kind)
        self.group = np.repeat(np.arange(CONDITIONS), WINDOWS)
        self.rows = {}
        self.fitted = 0
        self._fit(BASE)
        for name in self.names:
            self._fit(frozenset([name]))

    @property
    def table(self):
        return Table(dict(self.rows), self.laws, self.group, float(ROWS))

    def _fit(self, key):
        if key in self.rows:
            return
        self.fitted += 1
        own = [self.names.index(n) for n in sorted(key)]
        X, of = self.X[:, own], np.repeat(self.group, ROWS)
        cost = np.zeros(len(self.group))
        for g in range(CONDITIONS):
            t = np.linalg.lstsq(X[of != g], self.y[of != g], rcond=None)[0]
            each = ((self.y - X @ t) ** 2).reshape(-1, ROWS).sum(1)
            cost[self.group == g] = each[self.group == g]
        t = np.linalg.lstsq(X, self.y, rcond=None)[0]
        spread = np.mean((self.y - X @ t) ** 2)
        sd = np.sqrt(spread * np.diag(np.linalg.inv(X.T @ X))) if own else np.zeros(0)
        distance = dict(zip(sorted(key), np.abs(t) / sd, strict=True))
        self.rows[key] = Row(key, 3 + len(key), cost, float(len(self.y)), distance)

    def _moments(self, key):
        own = [self.names.index(n) for n in sorted(key)]
        fixed = self.X[:, own]
        out = lambda a: a - fixed @ np.linalg.lstsq(fixed, a, rcond=None)[0] if own else a  # noqa: E731
        return out(self.X), out(self.y)

    def promises(self, key):
        X, y = self._moments(key)
        gain = (X.T @ y) ** 2 / np.maximum(np.sum(X**2, 0), 1e-9)
        order = [self.names[i] for i in np.argsort(-gain)]
        fits_in = [n for n in order if all(self.laws[n].beside(self.laws[k]) for k in key)]
        return {n: gain[self.names.index(n)] for n in fits_in}

    def additions(self, key):
        return list(self.promises(key))

    def together(self, most, count):
        bound = np.full(len(self.names), 1e3)
        laws = [self.laws[n] for n in self.names]
        blocked = np.array([[a is not b and not a.beside(b) for a in laws] for b in laws])
        found = dense.best_sets(self.X.T @ self.X, self.X.T @ self.y, -bound, bound, blocked, most, count)
        return [frozenset(self.names[i] for i in own) for own, _ in found]

    def proposed(self, most):
        return []

    def over(self, part):
        return False

    def fit(self, plans, label, needed=False):
        for plan in plans:
            assert plan.parent in self.rows, f"{plan.key} from {plan.parent}, which was not fitted"
            self._fit(plan.key)

    def polish(self, keys):
        assert all(key in self.rows for key in keys)

    def simulate(self, keys):
        return Table({k: self.rows[k] for k in keys}, self.laws, self.group, float(ROWS))


def columns(count, seed=0):
    """So many unrelated laws: "a@hinge", "b@hinge", ..."""
    rng = np.random.default_rng(seed)
    size = CONDITIONS * WINDOWS * ROWS
    return {f"{chr(97 + i)}@hinge": rng.normal(size=size) for i in range(count)}
