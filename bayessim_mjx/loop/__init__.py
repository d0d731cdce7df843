"""The outer loop: train, collect, infer, repeat."""

from bayessim_mjx.loop.examination import reexamine
from bayessim_mjx.loop.findings import PREDICTIVE_DRAWS
from bayessim_mjx.loop.outer_loop import checkpoint_step, init, make, meta_of, run, step, train, tree_of
from bayessim_mjx.loop.state import Loop, LoopState, RoundInfo

__all__ = [
    "PREDICTIVE_DRAWS", "Loop", "LoopState", "RoundInfo", "checkpoint_step", "init", "make", "meta_of", "reexamine",
    "run", "step", "train", "tree_of",
]  # fmt: skip
