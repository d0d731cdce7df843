"""How far ranges that move may go in an environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayessim_mjx.parameters import limits


def limits_of(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest theta [d] that have a meaning in this environment.

    An effect's memory is as long as the range that it begins with, and nothing can be remembered beyond it.
    """
    physics, model = getattr(env, "physics", None), getattr(env, "mj_model", None)
    if physics is None:
        ends = [limits.ends(p) for p in env.space.parameters]
    else:
        ends = [limits.ends(p, model) for p in physics.blocks[0].parameters]
        for p, q in (pair for block in physics.blocks[1:] for pair in block.pairs()):
            ends.append((q.ends()[0], p.high if q.remembered else q.ends()[1]))
    low, high = np.asarray(ends, np.float64).reshape(-1, 2).T
    return low, high
