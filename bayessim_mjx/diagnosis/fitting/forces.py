"""What generalised forces do to the residuals of all windows: finite differences of forces at nodes in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import scales
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """Pulses that represent a force. Rules of thumb, not counted.

    Attributes:
        pulse: of a finite difference, as a share of the robot's force scale. Less is lost in single precision.
        columns: forces in a window, about so many. Each costs one simulation of all windows.
    """

    pulse: float = 0.03
    columns: int = 72


SIZES = Sizes()


def default_nodes(fitter: Fitter) -> int:
    """Return number of nodes in a window: one per control step for small robots, fewer for many joints, but six."""
    steps, nv = fitter.simulator.windows.steps, fitter.simulator.nv
    return min(steps, max(6, SIZES.columns // nv))


def node_basis(steps: int, nodes: int) -> Array:
    """Return `[steps, nodes]`: linear between nodes at the centres of equal pieces, constant beyond the ends."""
    at = (np.arange(nodes) + 0.5) * steps / nodes
    return np.stack([np.interp(np.arange(steps) + 0.5, at, row) for row in np.eye(nodes)], 1)


def force_scale(fitter: Fitter) -> Array:
    """`[nv]`: the largest force, or what would stop the joint within a window where nothing drives it."""
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    found = scales.measure(model, windows.logs)
    return np.maximum(found.force, found.inertia * found.speed / (windows.steps * windows.dt))


def columns(fitter: Fitter, fit: Fit, knots: int, scale: Array | None = None) -> Array:
    """D `[W, n, nv knots]`, one simulation of all windows per column, start states as in the fit."""
    windows, nv = fitter.simulator.windows, fitter.simulator.nv
    basis = node_basis(windows.steps, knots)
    pulse = SIZES.pulse * (force_scale(fitter) if scale is None else scale)
    force = np.zeros((nv, knots, 1, windows.steps, nv))
    for v in range(nv):
        force[v, :, 0, :, v] = basis.T * pulse[v]
    count = nv * knots
    spread = np.broadcast_to(force.reshape(count, 1, windows.steps, nv), (count, len(windows), windows.steps, nv))
    theta = np.repeat(fitter.vector(fit.coordinates, fit.values)[None], count, 0)
    shifted = fitter.whiten(fitter.simulator.run(theta, np.repeat(fit.offsets[None], count, 0), force=spread))
    return np.moveaxis((fit.r[None] - shifted) / np.repeat(pulse, knots)[:, None, None], 0, -1)
