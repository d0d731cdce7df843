"""A search that goes on where it was killed: the same question finds what was fitted in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import mujoco
import numpy as np

from bayessim_mjx import programs, versions
from bayessim_mjx.diagnosis.fitting.journal import Journal, Remembering, digest
from bayessim_mjx.diagnosis.selection.budget import Budget
from bayessim_mjx.diagnosis.setup import Setup


def remembering(setup: Setup, folder: Path | None) -> Setup:
    """The setup with a fitter that finds in the folder what it fitted there before, and writes what it fits."""
    if folder is None:
        return setup
    return replace(setup, fitter=Remembering(setup.fitter, Journal(folder, _question(setup), _code(setup))))


def ended(setup: Setup) -> None:
    """The search is over: later fits are not worth a file."""
    if isinstance(setup.fitter, Remembering):
        setup.fitter.journal = None


def _code(setup: Setup) -> str:
    """A digest of the code that makes the fits: this package's, and the files of effects from elsewhere."""
    return digest(versions.sources(), sorted({str(programs.source_of(type(e))) for e in setup.physics.effects}))


def _question(setup: Setup) -> str:
    """A digest of all that the fits depend on but code and the time that they may take."""
    fitter, model = setup.fitter, setup.physics.mj_model
    simulator = fitter.simulator
    raw = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, raw)
    windows = simulator.windows
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(windows.batch)]
    arrays += [windows.group, windows.sigma_q, windows.sigma_v, windows.spread, fitter.theta, raw]
    each = [(c.label, c.coordinates, c.shapes, c.probes.tobytes()) for c in setup.candidates]
    every = replace(setup.settings, budget=Budget())
    return digest(*arrays, fitter.base, each, every, simulator.lanes, jax.default_backend(), versions.versions())
