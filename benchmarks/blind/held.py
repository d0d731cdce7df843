"""Whether the strengths that one blind check tells hold on the fresh cases of another one of the same robot.

    python benchmarks/blind/held.py FIRST SECOND    # their --out folders; other seeds, the rest alike

The second check's single effects are predicted from the first check's curves alone: how many are found of each effect,
and of all. Counted is how often the number found lies in its 90 % predictive interval, which has what is not known of
curves, and the chances of single cases. Numbers are whole, so an interval holds more than 90 %
even where all is right; what it should hold is told beside what it held. And, by the chance that was told, how many of
that many were found.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import numpy as np

from bayessim_mjx.blind.curves import Curves, Group, Trial

DRAWS, LEVEL = 4000, 0.9
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of chances


def trials(folder: Path) -> list[Trial]:
    """Single effects of a check that were diagnosed."""
    return [Trial(**t) for t in json.loads((folder / "blind.json").read_text())["trials"]]


def alike(first: Path, second: Path) -> None:
    """Refuse checks of different robots, logs or diagnoses, and the same cases twice."""
    of = [json.loads((f / "blind.json").read_text())["settings"] for f in (first, second)]
    for key in sorted(of[0].keys() | of[1].keys()):
        if (of[0].get(key) != of[1].get(key)) != (key == "seed"):
            raise SystemExit(f"{key}: {of[0].get(key)} in {first}, {of[1].get(key)} in {second}")


def inside(draws: np.ndarray, found: float) -> tuple[float, float]:
    """(whether a number lies in the central interval of its draws, how often a draw does)."""
    low, high = np.quantile(draws, ((1 - LEVEL) / 2, (1 + LEVEL) / 2), method="inverted_cdf")
    return float(low <= found <= high), float(((draws >= low) & (draws <= high)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path)
    args = parser.parse_args()
    alike(args.first, args.second)
    curves, fresh, rng = Curves(trials(args.first)), trials(args.second), np.random.default_rng(0)
    groups: dict[Group, list[Trial]] = defaultdict(list)
    for t in fresh:
        groups[t.effect, t.where].append(t)
    draws = curves.numbers(fresh, DRAWS, rng)
    held = [inside(d, sum(t.found for t in fresh if t.effect == e)) for e, d in draws.items()]
    told = []
    for group, own in groups.items():
        mean = curves.of(*group).curve(np.array([t.strength for t in own]))[0]
        told += list(zip(mean, [t.found for t in own], strict=True))
    total = sum(draws.values())
    share, due = np.mean(held, axis=0)
    found, (low, high) = sum(f for _, f in told), np.quantile(total, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    score = np.mean([-np.log(p if f else 1 - p) for p, f in told])
    rate = np.mean([f for _, f in told])
    plain = -np.mean([np.log(rate if f else 1 - rate) for _, f in told])
    print(f"{len(fresh)} effects at {len(groups)} places: {found} found, ", end="")
    print(f"{total.mean():.1f} predicted ({low:.0f} to {high:.0f})")
    print(f"90 % intervals of the number found of an effect hold {share:.3f} of {len(held)}; {due:.3f} if all is right")
    print(f"log loss {score:.3f}; {plain:.3f} by the share found of all (hindsight)")
    for a, b in zip(BINS[:-1], BINS[1:], strict=True):
        some = [(p, f) for p, f in told if a <= p < b]
        if some:
            hits, sum_of = sum(f for _, f in some), sum(p for p, _ in some)
            print(f"chance {a:.1f} to {b:.1f}: {hits} of {len(some)} found, {sum_of:.1f} told")


if __name__ == "__main__":
    main()
