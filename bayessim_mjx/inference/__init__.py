"""Likelihood-free inference: summaries of trajectories -> posterior over theta. Knows no environment and no MJX."""

from bayessim_mjx.inference.data import Again
from bayessim_mjx.inference.fit import FitInfo, FitState, condition, fit, init
from bayessim_mjx.inference.identify import restore_prior
from bayessim_mjx.inference.posterior import combine, infer
from bayessim_mjx.inference.settings import InferenceSettings

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
