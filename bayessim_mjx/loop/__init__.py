"""The outer loop: train, collect, infer, repeat."""

from bayessim_mjx.loop.examination import reexamine, reused_posterior
from bayessim_mjx.loop.outer_loop import (
    PREDICTIVE_DRAWS,
    checkpoint_step,
    init,
    make,
    meta_of,
    run,
    step,
    train,
    tree_of,
)
from bayessim_mjx.loop.state import Loop, LoopState, RoundInfo

__all__ = [
    "PREDICTIVE_DRAWS", "Loop", "LoopState", "RoundInfo", "checkpoint_step", "init", "make", "meta_of", "reexamine",
    "reused_posterior", "run", "step", "train", "tree_of",
]  # fmt: skip
