"""A black-box residual: a ridge on random features of position, speed and command, tested on logs left out.

    python benchmarks/blind/entries/residual.py MODEL LOGS OUT

It can tell that something is left, and names nothing: `unexplained` where it predicts more than a tenth of the variance
that masses leave, else `parameters`.
"""

import sys

import numpy as np
from regression import Problem, least_squares, problems, write

FEATURES, RIDGE, LEAST = 120, 1e-2, 0.1


def predicted(p: Problem, rng: np.random.Generator) -> float:
    """Share of the variance of unexplained effort that is predicted on logs left out; negative where none is."""
    raw = p.X[:, [0, 1, 3, 4, 6, 7]]
    raw = (raw - raw.mean(0)) / (raw.std(0) + 1e-9)
    phase = raw @ rng.normal(size=(raw.shape[1], FEATURES)) + rng.uniform(0, 2 * np.pi, FEATURES)
    features = np.column_stack([np.cos(phase), raw, p.nuisance / (p.nuisance.std(0) + 1e-9)])
    left = total = 0.0
    _, _, without = least_squares(p, [])
    for group in np.unique(p.group):
        own, test = p.group != group, p.group == group
        A = features[own]
        x = np.linalg.solve(A.T @ A + RIDGE * len(A) * np.eye(A.shape[1]), A.T @ p.y[own])
        left += float(np.sum((p.y[test] - features[test] @ x) ** 2))
        total += without * test.mean()
    return 1 - left / max(total, 1e-300)


if __name__ == "__main__":
    if "--help" in sys.argv:
        sys.exit(print(f"usage: residual.py MODEL LOGS OUT\n{__doc__}"))
    best = max(predicted(p, np.random.default_rng(0)) for p in problems(sys.argv[1], sys.argv[2]))
    write("unexplained" if best > LEAST else "parameters")
