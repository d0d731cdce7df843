"""Likelihood-free inference: summaries of trajectories -> posterior over theta. Knows no environment and no MJX."""

from bayessim_mjx.inference.fit import FitInfo, FitState, combine, condition, fit, infer, init
from bayessim_mjx.inference.identify import restore_prior
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.inference.state import Again

__all__ = [
    "Again",
    "FitInfo",
    "FitState",
    "InferenceSettings",
    "combine",
    "condition",
    "fit",
    "infer",
    "init",
    "restore_prior",
]
