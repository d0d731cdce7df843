"""Whether the strengths that a blind check tells hold: its plan and its estimator on detection curves that are known.

    python benchmarks/blind/calibration.py --checks 200 [--only step,lapses] [--workers 1] [--cluster WHERE]

Every check draws the truth of a setting (thresholds of effects and places, slopes, lapses), plans its strengths round
by round as `bayessim-mjx blind` does, and finds or misses each hidden effect by the truth's chance. Counted are the
90 % intervals of the strength that is found 9 times of 10, for every effect and place that was tried. No robot is
simulated.
"""

import argparse
import dataclasses
import sys
import time
import zlib
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import brentq

from bayessim_mjx import pool
from bayessim_mjx.blind.cases import known, plan, rounds
from bayessim_mjx.blind.curves import WANTED, Curves, Group, Trial

Law = Callable[[float], float]  # log strength less log threshold, over the curve's width -> share found, without lapses


def logistic(x: float) -> float:
    return float(1 / (1 + np.exp(-np.clip(x, -60, 60))))


def weibull(x: float) -> float:
    """Rises slowly and ends early: the usual one of psychophysics, half found at 0."""
    return float(1 - np.exp(-np.log(2) * np.exp(np.clip(x, -60, 10))))


def heavy(x: float) -> float:
    """A Cauchy distribution: some weak ones are found, some strong ones missed."""
    return float(0.5 + np.arctan(x) / np.pi)


@dataclasses.dataclass(frozen=True)
class Truth:
    """A setting of true curves.

    Attributes:
        slopes: of logits per unit of log strength, drawn by effect; lapse: share of strong ones missed; guess: of weak
            ones found; among: spread of effects' log thresholds; within: of an effect's places; centre: of the effects.
        late: share of effects that are found at ten times the strength; law: shape of a curve.
        effects, places: how many; cases: of a check, nulls and unknown causes among them.
    """

    slopes: tuple[float, ...] = (2.0, 5.0)
    lapse: float = 0.02
    guess: float = 0.0
    among: float = 0.5
    within: float = 0.2
    centre: tuple[float, float] = (1.5, 3.5)
    late: float = 0.0
    law: Law = logistic
    effects: int = 12
    places: int = 2
    cases: int = 100


SETTINGS = {
    "as assumed": Truth(),
    "as assumed, 40 cases": Truth(cases=40),
    "as assumed, 60 cases": Truth(cases=60),
    "as assumed, 30 effects and places each": Truth(effects=30),
    "as assumed, 2 effects": Truth(effects=2),
    "steps": Truth(slopes=(1000.0,)),
    "flat curves": Truth(slopes=(1.2,)),
    "no lapses": Truth(lapse=0.0),
    "6 % lapses": Truth(lapse=0.06),
    "5 % found by chance": Truth(guess=0.05),
    "Weibull": Truth(law=weibull),
    "Cauchy": Truth(law=heavy, slopes=(8.0,)),
    "slopes from 1 to 40 by effect": Truth(slopes=(1.0, 2.5, 7.0, 40.0)),
    "a quarter of effects ten times later": Truth(late=0.25),
    "places that differ (0.8)": Truth(within=0.8),
    "effects that differ (1.5)": Truth(among=1.5),
}


@dataclasses.dataclass(frozen=True)
class Curve:
    """One effect at one place: log threshold, slope and the rest of its setting."""

    threshold: float
    slope: float
    truth: Truth

    def chance(self, strength: float) -> float:
        t = self.truth
        return t.guess + (1 - t.lapse - t.guess) * t.law(self.slope * (np.log(strength) - self.threshold))

    def wanted(self) -> float:
        """The strength that is found 9 times of 10."""
        return float(np.exp(brentq(lambda x: self.chance(np.exp(x)) - WANTED, -15, 25)))


def drawn(truth: Truth, rng: np.random.Generator) -> dict[Group, Curve]:
    """The curves of a robot."""
    centre, out = rng.uniform(*truth.centre), {}
    for e in range(truth.effects):
        own = rng.normal(centre, truth.among) + np.log(10) * (rng.uniform() < truth.late)
        slope = rng.choice(truth.slopes)
        for p in range(truth.places):
            out[f"e{e}", f"p{p}"] = Curve(rng.normal(own, truth.within), slope, truth)
    return out


def check(curves: dict[Group, Curve], cases: int, seed: int) -> list[Trial]:
    """The outcomes of a check, planned round by round."""
    rng, trials = np.random.default_rng((seed, 3)), dict[int, Trial]()
    for indices in rounds(cases):
        before = [t for i, t in trials.items() if i < known(indices)]
        for item in plan(indices, list(curves), [("unknown", "x")], before, seed):
            if item.kind == "single":
                found = rng.uniform() < curves[item.effect, item.where].chance(item.strength)
                trials[item.index] = Trial(item.effect, item.where, item.strength, bool(found))
    return list(trials.values())


def judged(name: str, seed: int) -> list[tuple[bool, float, float, float]]:
    """[(truth in the interval, log width, log error, chance at the strength told)] of what a check has tried."""
    truth = SETTINGS[name]
    curves = drawn(truth, np.random.default_rng((seed, zlib.crc32(name.encode()))))
    known, out = Curves(check(curves, truth.cases, seed)), []
    for group in known.trials:
        middle, low, high = known.of(*group).interval()
        wanted = curves[group].wanted()
        error = float(np.log(middle / wanted))
        out.append((low <= wanted <= high, float(np.log(high / low)), error, curves[group].chance(middle)))
    return out


def row(name: str, checks: Sequence[list[tuple[bool, float, float, float]]]) -> str:
    """A row of the table: coverage with the standard error of checks as clusters."""
    every = np.array([x for c in checks for x in c], float)
    each = np.array([np.mean([x[0] for x in c]) for c in checks])
    error = each.std(ddof=1) / np.sqrt(len(each))
    width, middle, bias = (np.exp(np.median(v)) for v in (every[:, 1], np.abs(every[:, 2]), every[:, 2]))
    return (
        f"| {name} | {100 * every[:, 0].mean():.1f} ± {100 * 1.96 * error:.1f} % | {width:.1f} | {middle:.2f} | "
        f"{bias:.2f} | {100 * every[:, 3].mean():.0f} % | {len(checks)}, {len(every)} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checks", type=int, default=200, help="of each setting")
    parser.add_argument("--only", default="", help="settings that begin with one of these words, separated by commas")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--workers", type=int, help="checks at a time (default: as many as cores)")
    parser.add_argument("--cluster", **pool.CLUSTER)
    args = parser.parse_args()
    words = tuple(args.only.split(",")) if args.only else ("",)
    print("| true curves | 90 % intervals hold | high over low | median error | told over true | found at the told strength | checks, thresholds |")  # fmt: skip # noqa: E501
    print("|---|---|---|---|---|---|---|", flush=True)
    with pool.executor(args.cluster, args.workers) as calls:
        for name in (n for n in SETTINGS if n.startswith(words)):
            started = time.process_time()
            seeds = range(args.first, args.first + args.checks)
            print(row(name, list(calls.map(judged, [name] * args.checks, seeds))), flush=True)
            print(f"{name}: {time.process_time() - started:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
