"""Forward selection of terms by BIC, every row counted as independent: the naive way.

python benchmarks/blind/entries/bic.py MODEL LOGS OUT
"""

import sys

import numpy as np
from regression import Problem, least_squares, place, problems, write


def bic(p: Problem, terms: list[int]) -> float:
    """N log(RSS / N) + k log N (Schwarz, 1978)."""
    n = len(p.y)
    return float(n * np.log(max(least_squares(p, terms)[2], 1e-300) / n) + len(terms) * np.log(n))


def terms_of(p: Problem) -> list[int]:
    """Terms added one after the other while BIC falls."""
    kept: list[int] = []
    best = bic(p, kept)
    while len(kept) < p.X.shape[1]:
        value, term = min((bic(p, [*kept, t]), t) for t in range(p.X.shape[1]) if t not in kept)
        if value >= best:
            break
        best, kept = value, [*kept, term]
    return kept


if __name__ == "__main__":
    if "--help" in sys.argv:
        sys.exit(print(f"usage: bic.py MODEL LOGS OUT\n{__doc__}"))
    found = [place(p, t) for p in problems(sys.argv[1], sys.argv[2]) for t in terms_of(p)]
    write("effects" if found else "parameters", found)
