"""The simulator as delivered, by plain MuJoCo: with the model's own integrator and time step.

Where nothing can touch, a diagnosis simulates by RK4. What a policy is trained with is the model as it is.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.simulator import FAR
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.logs.log import Log
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.parameters.reading import own_value
from bayessim_mjx.physics import controllers

Array = NDArray[np.float64]
INTEGRATORS = {
    int(mujoco.mjtIntegrator.mjINT_EULER): "Euler",
    int(mujoco.mjtIntegrator.mjINT_RK4): "RK4",
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT): "implicit",
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST): "implicitfast",
}


@dataclass(frozen=True, eq=False)
class Delivered:
    """A model in which nothing touches, with commands that act as they were logged.

    Attributes:
        model: its time step divides the control step; dt: the control step, s.
    """

    model: mujoco.MjModel
    dt: float

    @property
    def integrator(self) -> str:
        """Its name, as in an MJCF."""
        return INTEGRATORS[int(self.model.opt.integrator)]

    @property
    def steps(self) -> int:
        """Time steps in a control step."""
        return round(self.dt / self.model.opt.timestep)

    def plays(self, logs: Sequence[Log], space: ParameterSpace) -> bool:
        """Whether plain MuJoCo plays these logs: without loops beside the model, drives off, or actuators' memory.

        Args:
            space: of the model's parameters, whose nominal values are to be the model's own.
        """
        looped = controllers.of_logs(logs, self.model) is not None
        plain = not looped and all(log.enabled.all() for log in logs) and not self.model.na
        return plain and all(np.isclose(p.nominal, _own(self.model, p)) for p in space.parameters)

    def step_error(self, cut: Windows, offsets: Array, factor: int) -> Array:
        """Return the error of the time step `[W, H, 2 nv]`, commands held: beside RK4 at steps `factor` times as fine.

        Args:
            offsets: `[W, 2 nv]`, changes of the measured starts.
        """
        model, command = copy.copy(self.model), self.held(cut)
        model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, model.opt.timestep / factor
        return self.errors(cut, command, offsets) - replace(self, model=model).errors(cut, command, offsets)

    def held(self, cut: Windows) -> Array:
        """Commands `[W, H, nu]` held over control steps, as in training."""
        return np.stack([cut.logs[r].ctrl[a : a + cut.steps] for r, a in zip(cut.log, cut.start, strict=True)])

    def played(self, cut: Windows, offsets: Array) -> Array:
        """Return `errors` with the logged commands, their means over each of its steps; offsets: `[W, s]`."""
        command = np.asarray(cut.batch.command, np.float64)
        count, length, fine, nu = command.shape
        means = command.reshape(count, length, self.steps, fine // self.steps, nu).mean(3)
        return self.errors(cut, means, offsets[:, : 2 * self.model.nv])

    def recorded(
        self, starts: list[tuple[int, int]], cut: Windows, logs: Sequence[Log], moved: float, many: int = 1
    ) -> Windows:
        """Return windows with commands as they were recorded.

        Args:
            starts: (log, row); cut: windows of a length, which these have, or many of it.
            logs: of the windows, whose commands were moved by so many s.
        """
        given, length = [log.shifted(-moved) for log in logs], cut.steps * many
        return windows.cut(
            given, self.model, cut.dt, self.steps, length, limit=len(starts), starts=starts, centred=False
        )

    def errors(self, cut: Windows, command: Array, offsets: Array) -> Array:
        """Measured minus simulated `[W, H, 2 nv]`.

        Args:
            command: `[W, H, nu]` held, or `[W, H, steps, nu]`; offsets: `[W, 2 nv]`, changes of the measured starts.
        """
        model, nv, count = self.model, self.model.nv, len(cut)
        each = command[:, :, None] if command.ndim == 3 else command
        ctrl = np.repeat(each, self.steps // each.shape[2], 2).reshape(count, -1, model.nu)
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        data, states = mujoco.MjData(model), np.zeros((count, mujoco.mj_stateSize(model, kind)))
        around = cut.batch.around
        measured = (np.asarray(getattr(around, x), np.float64)[:, around.start] for x in ("qpos", "qvel"))
        for state, qpos, qvel, offset in zip(states, *measured, offsets, strict=True):
            mujoco.mj_integratePos(model, qpos, offset[:nv], 1.0)
            data.qpos[:], data.qvel[:] = qpos, qvel + offset[nv:]
            mujoco.mj_getState(model, data, state, kind)
        found, _ = mujoco.rollout.rollout(model, data, states, ctrl)
        ends = found[:, self.steps - 1 :: self.steps, 1:]
        return _apart(model, cut, ends[..., : model.nq], ends[..., model.nq : model.nq + nv])


def _own(model: mujoco.MjModel, p: Parameter) -> float:
    """Return the value of a parameter that changes nothing."""
    if p.operation == "absolute":
        return own_value(model, p.kind, p.attribute, p.target) / p.factor
    return float(p.operation == "scaling")


def _apart(model: mujoco.MjModel, cut: Windows, qpos: Array, qvel: Array) -> Array:
    """Measured minus simulated `[W, H, 2 nv]`, positions in the tangent space."""
    seen = np.asarray(cut.batch.qpos, np.float64)
    out = np.concatenate([np.zeros_like(qvel), np.asarray(cut.batch.qvel, np.float64) - qvel], axis=2)
    for row, x, y in zip(out.reshape(-1, 2 * model.nv), _rows(qpos), _rows(seen), strict=True):
        mujoco.mj_differentiatePos(model, row[: model.nv], 1.0, x, y)
    return np.nan_to_num(out, nan=FAR, posinf=FAR, neginf=-FAR)


def _rows(values: Array) -> Array:
    return np.ascontiguousarray(values.reshape(-1, values.shape[-1]))
