"""How much rows tell that repeat an encoder's count: coverage of posteriors in closed form.

    python benchmarks/inference/counts.py --dt .04 --sets 300

The cart of refinement.py, whose positions are linear in two motors' strengths and the start. Positions are rounded to
counts, and the posterior takes their errors for white noise of a count / sqrt 12: as they are, and with the factor of
`loop/likelihood.repeated`, by which at most four rows of each run of equal values count. Starts are free, 4
trajectories a set. The table has the root mean squares of z (1 where calibrated) and how often regions of 50, 80, 95 %
hold the truth.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.linalg import expm

from bayessim_mjx.loop.likelihood import ROWS

MASS, DAMPING, STIFFNESS, GAINS = 2.0, 1.0, 4.0, (10.0, 5.0)
SECONDS, HELD, TRAJECTORIES = 2.4, 0.2, 4
LEVELS = (0.5, 0.8, 0.95)


def responses(command: np.ndarray, dt: float) -> np.ndarray:
    """[T + 1, 4] of positions to both strengths, start and start speed, under command [T, 2]."""
    whole = np.zeros((4, 4))
    whole[:2] = [[0, 1, 0, 0], [-STIFFNESS / MASS, -DAMPING / MASS, *(g / MASS for g in GAINS)]]
    step = expm(whole * dt)
    state = np.concatenate([np.zeros((2, 2)), np.eye(2)], axis=1)
    rows = [state[0]]
    for u in command:
        state = step[:2, :2] @ state
        state[:, :2] += step[:2, 2:] * u
        rows.append(state[0])
    return np.array(rows)


def told(y: np.ndarray) -> tuple[int, int]:
    """(rows that tell, runs of equal values) in y [T]."""
    ends = np.flatnonzero(np.diff(y)) + 1
    runs = np.diff([0, *ends, len(y)])
    return int(np.minimum(runs, ROWS).sum()), len(runs)


def judged(rng: np.random.Generator, dt: float, count: float) -> tuple[np.ndarray, np.ndarray, float, float]:
    """(error [2], precision [2, 2] by white noise, rows over rows that tell, rows a run) of one set."""
    theta, precision, pull, rows, new, runs = rng.uniform(0.2, 3, 2), np.zeros((2, 2)), np.zeros(2), 0, 0, 0
    steps, held = round(SECONDS / dt), round(HELD / dt)
    for _ in range(TRAJECTORIES):
        command = np.repeat(rng.uniform(-1, 1, (steps // held, 2)), held, axis=0)
        slopes = responses(command, dt)
        y = count * np.round(slopes @ [*theta, *rng.uniform(-1, 1, 2)] / count)
        free = np.eye(len(y)) - slopes[:, 2:] @ np.linalg.pinv(slopes[:, 2:])
        precision += slopes[:, :2].T @ free @ slopes[:, :2] * 12 / count**2
        pull += slopes[:, :2].T @ free @ y * 12 / count**2
        found = told(y)
        rows, new, runs = rows + len(y), new + found[0], runs + found[1]
    return theta - np.linalg.solve(precision, pull), precision, rows / new, rows / runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dt", type=float, nargs="+", default=[0.04, 0.01], help="s between rows")
    parser.add_argument("--count", type=float, nargs="+", default=[0.7, 0.35, 0.17, 0.07], help="of the encoder, m")
    parser.add_argument("--sets", type=int, default=300)
    a = parser.parse_args()
    print("| dt, s | count, m | rows a count | z as it is | 50 / 80 / 95 % | z with it | 50 / 80 / 95 % |")
    print("|---|---|---|---|---|---|---|")
    for dt in a.dt:
        for count in a.count:
            rng = np.random.default_rng(0)
            found = [judged(rng, dt, count) for _ in range(a.sets)]
            cells = []
            for known in (False, True):
                far = np.array([e @ p @ e / (more if known else 1.0) for e, p, more, _ in found])
                held = [np.mean(1 - np.exp(-far / 2) <= level) for level in LEVELS]
                cells += [f"{np.sqrt(np.mean(far) / 2):.2f}", " ".join(f"{x:.2f}" for x in held)]
            print(f"| {dt:g} | {count:g} | {np.mean([x[3] for x in found]):.1f} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
