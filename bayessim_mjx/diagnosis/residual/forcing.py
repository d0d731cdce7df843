"""What a generalised force does to each window's residual: columns by finite differences, one simulation each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import scales
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, Starts, eliminate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """Pulses by which the missing force is told."""

    pulse: float = 0.03  # of the robot's force scale: finite differences
    # about so many forces per window unless told otherwise; each costs one simulation of all windows
    columns: int = 72


SIZES = Sizes()


@dataclass(frozen=True, eq=False)
class Linear:
    """A fit's residuals as a linear function of a force over each window.

    Attributes:
        D: `[W, n, nv m]`, minus the derivative of the whitened residual; column v m + k: force of dof v, node k.
        basis: `[H, m]`, force in each control step from the forces at the nodes.
        scale: `[nv]`, size of the forces of this robot, N m or N.
        r: `[W, n]`, residuals extrapolated to no force, no parameter step and the fit's start states.
        quadratic: in (the fit's parameters' steps, forces), start states eliminated; starts: what was eliminated.
    """

    D: Array
    basis: Array
    scale: Array
    r: Array
    quadratic: Quadratic
    starts: Starts

    @property
    def nodes(self) -> int:
        return int(self.basis.shape[1])

    def forces(self, flat: Array) -> Array:
        """`[..., nv m]` -> `[..., H, nv]`, per control step."""
        nodes = flat.reshape(*flat.shape[:-1], len(self.scale), self.nodes)
        return np.einsum("hm,...vm->...hv", self.basis, nodes)


def default_nodes(fitter: Fitter) -> int:
    """One node per control step for small robots, fewer where every joint needs its own columns."""
    steps, nv = fitter.simulator.windows.steps, fitter.simulator.nv
    return min(steps, max(6, SIZES.columns // nv))


def node_basis(steps: int, nodes: int) -> Array:
    """`[steps, nodes]`: linear between nodes at the centres of equal pieces of the window, constant beyond the ends."""
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


def linearise(fitter: Fitter, fit: Fit, knots: int | None = None, D: Array | None = None) -> Linear:
    """Columns and quadratic at the fit's point; D: columns of another fit, to save the simulations."""
    knots = default_nodes(fitter) if knots is None else knots
    scale = force_scale(fitter)
    D = columns(fitter, fit, knots, scale) if D is None else D
    q, starts = eliminate(fit.r, np.concatenate([fit.A, D], 2), fit.B, fit.offsets, fitter.spread)
    return Linear(D, node_basis(fitter.simulator.windows.steps, knots), scale, fit.r, q, starts)
