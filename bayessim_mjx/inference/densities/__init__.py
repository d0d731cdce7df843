"""Density models, by BayesSimIG's names: each is one `Density`, registered where it is.

A user's own is registered by a call of `register`, or by an entry point of the group bayessim_mjx.densities
(docs/own_summary.md).
"""

from bayessim_mjx.inference.densities import mdnn, mdrff
from bayessim_mjx.inference.densities.density import Density, Drop, Params, density_of, register, started

__all__ = ["Density", "Drop", "Params", "density_of", "register", "started"]

LIBRARY = (mdnn, mdrff)  # importing them registers what they define
