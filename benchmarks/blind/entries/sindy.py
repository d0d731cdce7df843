"""Sparse regression of unexplained efforts (SINDy, Brunton et al. 2016), terms dropped one at a time.

python benchmarks/blind/entries/sindy.py MODEL LOGS OUT
"""

import numpy as np
from regression import Problem, least_squares, place, problems, write

SHARE = 0.15  # of the unexplained effort (rms): smaller terms are dropped
MOST = 3  # terms at a joint: more cancel each other
RIDGE = 0.05  # of the squares of a term, as in PySINDy's default
LEAST = 0.1  # of its variance that the terms have to explain


def terms_of(p: Problem) -> list[int]:
    """Terms that stay, the largest first."""
    kept = list(range(p.X.shape[1]))
    size = np.sqrt(np.mean(p.X**2, 0))
    while kept:
        x, _, rss = least_squares(p, kept, RIDGE)
        part = np.abs(x) * size[kept] / max(float(np.sqrt(np.mean(p.y**2))), 1e-12)
        smallest = int(np.argmin(part))
        if part[smallest] >= SHARE and len(kept) <= MOST:
            explained = 1 - rss / max(float(np.sum(p.y**2)), 1e-12)
            return [kept[i] for i in np.argsort(-part)] if explained > LEAST else []
        del kept[smallest]
    return []


if __name__ == "__main__":
    import sys

    if "--help" in sys.argv:
        sys.exit(print(f"usage: sindy.py MODEL LOGS OUT\n{__doc__}"))
    found = [place(p, t) for p in problems(sys.argv[1], sys.argv[2]) for t in terms_of(p)[:1]]
    write("effects" if found else "parameters", found)
