"""Detection curves: from cases of known strength that were found or missed to the strength that is found 9 times of 10.

A logistic curve in the logarithm of strength with a small lapse rate. The strengths at which effects are found half the
time are drawn from a population, those of an effect's places from the effect's own (a hierarchical model), so that few
cases of each suffice; so are slopes. All is integrated on grids: there is nothing to converge.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np

# What is believed before any case, by choice. That intervals hold as often as they say was counted on simulated checks
# alone (benchmarks/blind/calibration.py, benchmarks/records/blind_strengths.json).
LAPSE = 0.02  # of what is easily seen, missed for other reasons: within the 0 to 6 % of Wichmann and Hill (2001)
WANTED = 0.9  # how often the strength is found that is reported
LEVEL = 0.9  # of intervals
THRESHOLD = np.linspace(
    np.log(0.3), np.log(3000.0), 185
)  # log strength, in encoder noises, that is found half the time
SLOPE = np.array([1.0, 1.6, 2.5, 4.0, 7.0, 14.0, 40.0])  # of the curve's logit, per unit of log strength
AMONG_SLOPES = np.array([0.1, 0.7])  # standard deviations of effects' log slopes: alike, or within a factor of two
AMONG_PLACES = np.array([0.08, 0.25, 0.6])  # standard deviations of thresholds, of an effect's places
AMONG_EFFECTS = np.array([0.15, 0.4, 0.8, 1.3])  # and of effects
CENTRE = np.linspace(np.log(1.0), np.log(300.0), 24)  # of the population, log strength
Group = tuple[str, str]  # effect, place


@dataclasses.dataclass(frozen=True)
class Trial:
    """One hidden effect: strength in encoder noises, and whether the diagnosis named it at its place."""

    effect: str
    where: str
    strength: float
    found: bool


def chance(strength: np.ndarray, threshold: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """How often a log strength is found."""
    return (1 - LAPSE) / (1 + np.exp(-np.clip(slope * (strength - threshold), -60, 60)))


@dataclasses.dataclass(frozen=True, eq=False)
class Belief:
    """What is known of one curve: weights `[slopes, thresholds]` that sum to 1."""

    weight: np.ndarray

    def quantiles(self, at: Iterable[float], share: float = WANTED) -> np.ndarray:
        """Quantiles of the strength (encoder noises) that is found in `share` of all cases."""
        odds = share / (1 - LAPSE)
        x = THRESHOLD[None, :] + np.log(odds / (1 - odds)) / SLOPE[:, None]
        order = np.argsort(x, axis=None)
        sums = np.cumsum(self.weight.ravel()[order])
        return np.exp(np.interp(list(at), (sums - 0.5 * self.weight.ravel()[order]) / sums[-1], x.ravel()[order]))

    def interval(self, share: float = WANTED) -> tuple[float, float, float]:
        """(median, low, high) of the same, with a 90 % interval."""
        half = (1 - LEVEL) / 2
        low, middle, high = self.quantiles((half, 0.5, 1 - half), share)
        return float(middle), float(low), float(high)

    def curve(self, strength: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(mean, low, high) of how often each strength is found, with a 90 % band."""
        p = chance(np.log(strength)[:, None, None], THRESHOLD[None, None], SLOPE[None, :, None]).reshape(
            len(strength), -1
        )
        weight = self.weight.ravel()
        bands = []
        for row in p:
            order = np.argsort(row)
            bands.append(np.interp(((1 - LEVEL) / 2, (1 + LEVEL) / 2), np.cumsum(weight[order]), row[order]))
        return p @ weight, *np.array(bands).T

    def draw(self, rng: np.random.Generator, share: float) -> float:
        """Draw a curve from what is known and return the strength that it finds in `share` of all cases."""
        k = rng.choice(self.weight.size, p=self.weight.ravel() / self.weight.sum())
        slope, threshold = SLOPE[k // len(THRESHOLD)], THRESHOLD[k % len(THRESHOLD)]
        odds = share / (1 - LAPSE)
        return float(np.exp(threshold + np.log(odds / (1 - odds)) / slope))


def _bell(x: np.ndarray, middle: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Compute normal densities over the last axis `x`, normalised on the grid."""
    density = np.exp(-0.5 * ((x - middle[..., None]) / sd[..., None]) ** 2)
    return density / density.sum(-1, keepdims=True)


_SLOPES = np.concatenate(
    [_bell(np.log(SLOPE), np.log(SLOPE), np.full(1, sd)) for sd in AMONG_SLOPES]
)  # [populations, slopes]
_PLACE = _bell(THRESHOLD, THRESHOLD[None, :].repeat(len(AMONG_PLACES), 0), AMONG_PLACES[:, None])  # [P, T, T']
_EFFECT = _bell(
    THRESHOLD, CENTRE[:, None] + 0 * AMONG_EFFECTS, AMONG_EFFECTS[None, :] + 0 * CENTRE[:, None]
)  # [U, V, T]


class Curves:
    """The curves of all effects and places, given trials."""

    def __init__(self, trials: Iterable[Trial]) -> None:
        groups: dict[Group, list[Trial]] = defaultdict(list)
        for t in trials:
            groups[t.effect, t.where].append(t)
        self.trials: Mapping[Group, list[Trial]] = dict(groups)
        self._own = {g: self._likelihood(own) for g, own in groups.items()}  # [slopes, thresholds]
        # what each place says of its effect's threshold, [slopes, P, thresholds]
        self._place = {g: np.tensordot(own, _PLACE, ([1], [2])) for g, own in self._own.items()}

    @staticmethod
    def _likelihood(trials: Iterable[Trial]) -> np.ndarray:
        out = np.ones((len(SLOPE), len(THRESHOLD)))
        for t in trials:
            p = chance(np.log(t.strength), THRESHOLD[None], SLOPE[:, None])
            out = out * (p if t.found else 1 - p)
        return np.maximum(out, 1e-290)

    def all_of(self, effect: str) -> list[Trial]:
        """Trials of an effect at all its places."""
        return [t for (e, _), own in self.trials.items() if e == effect for t in own]

    @cached_property
    def _effects(self) -> dict[str, np.ndarray]:
        """{effect: what its places together say of its threshold [slopes, P, T]}."""
        out: dict[str, np.ndarray] = {}
        for (effect, _), said in self._place.items():
            out[effect] = out.get(effect, np.ones_like(said)) * said
        return {e: m / m.max() for e, m in out.items()}

    @cached_property
    def _evidence(self) -> dict[str, np.ndarray]:
        """{effect: its evidence [slopes, P, U, V]} for every population."""
        return {e: np.tensordot(m, _EFFECT, ([2], [2])) for e, m in self._effects.items()}

    @cached_property
    def _population(self) -> np.ndarray:
        """Log weights `[populations of slopes, P, U, V]` of populations, by all effects."""
        log = np.zeros((len(_SLOPES), len(AMONG_PLACES), len(CENTRE), len(AMONG_EFFECTS)))
        for z in self._evidence.values():
            log = log + np.log(np.maximum(np.tensordot(_SLOPES, z, 1), 1e-290))
        return log

    def of(self, effect: str, where: str) -> Belief:
        """Give what is known of one effect at one place, also where it was never tried."""
        log = self._population
        if effect in self._evidence:
            log = log - np.log(np.maximum(np.tensordot(_SLOPES, self._evidence[effect], 1), 1e-290))
        weight = np.exp(log - log.max())
        others = np.tensordot(_SLOPES.T, np.tensordot(weight, _EFFECT, ([2, 3], [0, 1])), 1)
        for (e, w), said in self._place.items():
            if e == effect and w != where:
                others = others * said / said.max()
        own = self._own.get((effect, where), np.ones((len(SLOPE), len(THRESHOLD))))
        found = np.tensordot(others, _PLACE, ([1, 2], [0, 1])) * own
        return Belief(found / found.sum())

    def numbers(self, fresh: Iterable[Trial], draws: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """{effect: `[draws]`, how many of its fresh trials are found}: population, effect, place, then trials."""
        groups: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for t in fresh:
            groups[t.effect][t.where].append(np.log(t.strength))
        out = {effect: np.zeros(draws) for effect in groups}
        weight, untried = np.exp(self._population - self._population.max()), np.ones((len(SLOPE), len(THRESHOLD)))
        for i in range(draws):
            spread, places, centre, among = np.unravel_index(_one(weight, rng), weight.shape)
            for effect, own in groups.items():
                said = self._effects[effect][:, places] if effect in self._effects else untried
                joint = _SLOPES[spread][:, None] * said * _EFFECT[centre, among][None]
                slope, middle = np.unravel_index(_one(joint, rng), joint.shape)
                for where, strengths in own.items():
                    likely = self._own.get((effect, where), untried)[slope]
                    threshold = THRESHOLD[_one(_PLACE[places, middle] * likely, rng)]
                    found = rng.uniform(size=len(strengths)) < chance(np.array(strengths), threshold, SLOPE[slope])
                    out[effect][i] += found.sum()
        return out


def _one(weight: np.ndarray, rng: np.random.Generator) -> int:
    """Flat index of a draw by weights."""
    sums = np.cumsum(weight)
    return int(np.searchsorted(sums, rng.uniform(0, sums[-1])))
