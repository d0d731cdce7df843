"""What a simulator with right laws and right numbers still differs by: numbers of their own, and so in the evidence.

Positions and velocities are rows of two sensors. Each lies in time as exactly as its sensor reads, and a robot's clock
is not the simulator's: half a sub-step lies between the positions and the velocities of one semi-implicit step. Without
these lags known parameters would take such errors, and pretend to know them. A stiff servo that sees its joint late
damps it less, by the stiffness times the lag, which is as much as a joint's own damping. Damping that acts late, of a
servo or of the joint, moves the inertia: through a motor's inductance, or in a simulator that takes it from the speed
before the step.

The missing force of one window is independent of that of another. A law that is not quite right is wrong in all of them
alike, wherever the motion is the same, and numbers take it: `common` has errors of the missing force's size that are
functions of the state (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection.numbers import PRIORS

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Doubts:
    """What one prior standard deviation of each does to the residuals: of its own, and as known parameters do.

    Attributes:
        columns: `[W, n, T]`; as_known: `[k, T]`, steps of the known parameters.
    """

    columns: Array
    as_known: Array

    def beside(self, fit: Fit) -> Fit:
        """Return the fit with these numbers behind its own, in units of their priors."""
        own = np.asarray(self.columns + fit.A[:, :, : len(self.as_known)] @ self.as_known)
        names = [f"doubt{i}" for i in range(own.shape[2])]
        more = tuple(Coordinate(name, (), 0.0, -np.inf, np.inf, 1.0, "", stated=True) for name in names)
        values = np.concatenate([fit.values, np.zeros(len(more))])
        return replace(fit, coordinates=(*fit.coordinates, *more), values=values, A=np.concatenate([fit.A, own], 2))


def found(fitter: Fitter, D: Array, B: Array) -> Doubts:
    """Lags of measured positions, of measured velocities, of positions that servos are fed back, of all damping.

    A late start moves all of a window's motion.

    Args:
        D: as in `disturbance.columns`; B: `[W, n, s]`, of the start states (positions, then velocities).
    """
    windows, nv = fitter.simulator.windows, fitter.simulator.nv
    rate, measured = fitter.rate(), fitter.used[nv:].any()
    channels = np.arange(rate.shape[1]) % int(fitter.used.sum())
    positions = channels < int(fitter.used[:nv].sum())
    start, pull = (x[:, 0] for x in _rates(fitter, np.asarray(windows.start)[:, None]))
    from_start = [np.einsum("wns,ws->wn", b, x) for b, x in ((B[:, :, :nv], start), (B[:, :, nv : 2 * nv], pull))]
    late_q = from_start[0] - rate * positions + (0.0 if measured else from_start[1])
    late_v = (from_start[1] - rate * ~positions) * measured
    servos, as_known = _servos(fitter, D)
    every = np.stack([late_q, late_v, *servos], 2)
    known = np.concatenate([np.zeros((len(as_known), 2)), as_known], 1)
    kept = (np.abs(every).max((0, 1)) > 0) | np.any(known != 0, 0)
    return Doubts(
        PRIORS.times * float(windows.dt) * every[:, :, kept], PRIORS.times * float(windows.dt) * known[:, kept]
    )


def _servos(fitter: Fitter, D: Array) -> tuple[list[Array], Array]:
    """(`[W, n]` each, `[k, 2]`), per s of lag of the positions that servos are fed back, and of what damps joints.

    A late position is less damping of the joint, a late velocity less armature. Where these are known parameters the
    columns are theirs: forces at nodes lack what accelerations do between them, and would trade it for a parameter.
    """
    model, nv = fitter.simulator.physics.mj_model, fitter.simulator.nv
    names = [c.name for c in fitter.base]
    parameters = {(p.attribute, p.target): p for p in fitter.simulator.physics.space.parameters if p.name in names}
    kinds = (("damping", model.dof_damping), ("armature", model.dof_armature))
    columns, as_known = [], np.zeros((len(names), 2))
    for i, (gain, force) in enumerate(zip(_pulls(model), _pulled(fitter, D.shape[2] // nv), strict=True)):
        attribute, own = kinds[i]
        by_joint = force.reshape(len(force), nv, -1).copy()
        for dof in np.flatnonzero(np.diag(gain)):
            p = parameters.get((attribute, model.joint(int(model.dof_jntid[dof])).name))
            if p is not None and p.operation == "scaling" and own[dof] > 0:
                as_known[names.index(p.name), i] = -gain[dof, dof] / own[dof]
                by_joint[:, dof] = 0.0
        columns.append(np.einsum("wnf,wf->wn", D, by_joint.reshape(force.shape)))
    return columns, as_known


def _pulls(model: mujoco.MjModel) -> tuple[Array, Array]:
    """`[nv, nv]` each, N m/rad and N m s/rad, or N/m and N s/m: servos' pull on joints by position, all by speed."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moment = moments(model, data)
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    gains = np.where(affine[:, None], -model.actuator_biasprm[:, 1:3], 0.0)
    by_position, by_speed = (moment.T @ (gain[:, None] * moment) for gain in gains.T)
    return by_position, by_speed + np.diag(model.dof_damping)


def _pulled(fitter: Fitter, nodes: int) -> tuple[Array, Array]:
    """`[W, nv m]` each, N m/s or N/s: how fast servos' forces on joints change, by position and by speed as logged."""
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    rows = windows.start[:, None] + ((np.arange(nodes) + 0.5) * windows.steps / nodes).round().astype(int)
    forces = [rate @ pull for rate, pull in zip(_rates(fitter, rows), _pulls(model), strict=True)]
    by_position, by_speed = (np.nan_to_num(np.moveaxis(f, 1, 2).reshape(len(f), -1)) for f in forces)
    return by_position, by_speed


def _rates(fitter: Fitter, rows: NDArray[np.int64]) -> tuple[Array, Array]:
    """Speeds and their slopes `[W, m, nv]` at rows `[W, m]` of each window's log."""
    windows = fitter.simulator.windows
    speeds = [log.qvel for log in windows.logs]
    slopes = [np.gradient(v, windows.dt, axis=0) for v in speeds]
    at = list(zip(windows.log, rows, strict=True))
    return np.stack([speeds[log][own] for log, own in at]), np.stack([slopes[log][own] for log, own in at])


def common(fitter: Fitter, D: Array, size: Array) -> Array:
    """`[W, n, c]`: what one standard deviation of forces that are alike in all windows does to the residuals.

    Each is as large as the missing force. They are M a, the model's forces by speed and by position, dry friction, and
    for each joint any function of its speed and any of its position: values of their own in as many cells of the motion
    as a window has nodes, all as full.

    Args:
        D: as in `disturbance.columns`; size: `[nv]`, rms of the missing force, N m or N.
    """
    nodes, out = D.shape[2] // len(size), [np.zeros((*D.shape[:2], 0))]
    if not size.any():
        return out[0]
    forces, states = of_motion(fitter, nodes)
    rms = np.sqrt(np.mean(forces**2, axis=(0, 3), keepdims=True))
    forces = forces / np.where(rms > 0, rms, np.inf)
    for joint in np.flatnonzero(size):
        cells = [
            np.searchsorted(np.quantile(x, np.arange(1, nodes) / nodes), x)[:, None] == np.arange(nodes)[:, None]
            for x in states[:, :, joint].swapaxes(0, 1)
        ]
        shapes = np.concatenate([forces[:, :, joint], *cells], 1) * size[joint]
        out.append(D[:, :, joint * nodes : (joint + 1) * nodes] @ shapes.mT)
    return np.concatenate(out, 2)


def of_motion(fitter: Fitter, nodes: int) -> tuple[Array, Array]:
    """Return forces `[W, 4, nv, m]`: M a, by speed, by position (N m or N), by direction (its sign); then the states.

    These are speeds and positions `[W, 2, nv, m]`, all at the nodes.
    """
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    data, count = mujoco.MjData(model), windows.steps
    at = np.clip(((np.arange(nodes) + 0.5) * count / nodes).round().astype(int), 0, count)
    out = np.zeros((len(windows), 6, model.nv, nodes))
    for w, (log, start) in enumerate(zip(windows.log, windows.start, strict=True)):
        rows = start + np.arange(count + 1)
        qpos, qvel = windows.logs[log].qpos[rows], windows.logs[log].qvel[rows]
        qacc = np.gradient(qvel, windows.dt, axis=0)
        for m, row in enumerate(at):
            out[w, :, :, m] = _at(model, data, qpos[row], qvel[row], qacc[row])
    out = np.nan_to_num(out)
    return out[:, :4], out[:, 4:]


def _at(model: mujoco.MjModel, data: mujoco.MjData, qpos: Array, qvel: Array, qacc: Array) -> Array:
    """`[6, nv]` at one state."""
    data.qpos[:], data.qvel[:] = qpos, 0.0
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    by_position = data.qfrc_bias - data.qfrc_passive
    inertial, position = np.zeros((2, model.nv))
    mujoco.mj_mulM(model, data, inertial, np.ascontiguousarray(qacc))
    mujoco.mj_differentiatePos(model, position, 1.0, model.qpos0, np.ascontiguousarray(qpos))
    data.qvel[:] = qvel
    mujoco.mj_fwdVelocity(model, data)
    by_speed = data.qfrc_bias - data.qfrc_passive - by_position
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    drives = np.where(affine, model.actuator_biasprm[:, 2], 0.0) * data.actuator_velocity
    return np.stack([inertial, by_speed - drives @ moments(model, data), by_position, np.sign(qvel), qvel, position])


def moments(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """`[nu, nv]`, the force on joints of one unit of each actuator's force."""
    out = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(out, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return out
