"""The model as it was delivered, from row to row of a log, by MuJoCo itself, and its derivatives by the state."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.logcheck.drives import DeclaredLaw
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import controllers

Array = NDArray[np.float64]
# rad or m, rad/s or m/s, of the finite differences: as usual with MuJoCo's own (mjd_transitionFD). Rounding of doubles
# costs about 1e-10 then; what is lost where a contact begins was not measured.
NUDGE = 1e-6


class Stepper:
    """Steps of a log: its commands through its controller, at the model's own step or a little less.

    States are (qpos `[nq]`, qvel `[nv]`); changes of them `[2 nv]` are in the tangent space.
    """

    def __init__(self, model: mujoco.MjModel, log: Log) -> None:
        self.model, self.log, self.nv = copy.copy(model), log, int(model.nv)
        self.data, self.longest = mujoco.MjData(self.model), float(model.opt.timestep)
        declared = controllers.declared(log.metadata)
        source = str(log.metadata.get("source", log.name))
        law = controllers.read(log.metadata, model, log.actuators, source) if declared else None
        self.loop = None if law is None else DeclaredLaw(law)

    def reset(self) -> None:
        """Actuators without a past."""
        mujoco.mj_resetData(self.model, self.data)

    def advanced(self, qpos: Array, qvel: Array, row: int) -> tuple[Array, Array]:
        """The state at the next row."""
        data, span = self.data, float(self.log.time[row + 1] - self.log.time[row])
        steps = max(1, int(np.ceil(span / self.longest - 1e-6)))
        self.model.opt.timestep = span / steps
        command = self.log.ctrl[row]
        if self.log.linear:
            command = 0.5 * (command + self.log.ctrl[row + 1])
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, qvel, 0.0
        data.ctrl[:] = command
        for _ in range(steps):
            if self.loop is not None:
                data.ctrl[:] = self.loop(command, data.qpos, data.qvel)
            mujoco.mj_step(self.model, data)
        return data.qpos.copy(), data.qvel.copy()

    def linearised(self, qpos: Array, qvel: Array, row: int) -> tuple[Array, Array, Array]:
        """(qpos, qvel) at the next row, and their derivatives by the state `[2 nv, 2 nv]`."""
        before = self.data.act.copy()
        ends = self.advanced(qpos, qvel, row)
        after = self.data.act.copy()
        way = np.empty((2 * self.nv, 2 * self.nv))
        for i, nudge in enumerate(NUDGE * np.eye(2 * self.nv)):
            self.data.act[:] = before
            way[:, i] = self.difference(*ends, *self.advanced(*self.moved(qpos, qvel, nudge), row)) / NUDGE
        self.data.act[:] = after
        return *ends, way

    def moved(self, qpos: Array, qvel: Array, change: Array) -> tuple[Array, Array]:
        there = np.array(qpos)
        mujoco.mj_integratePos(self.model, there, change[: self.nv], 1.0)
        return there, qvel + change[self.nv :]

    def difference(self, qpos: Array, qvel: Array, to_qpos: Array, to_qvel: Array) -> Array:
        """The change `[2 nv]` from one state to another."""
        out = np.empty(2 * self.nv)
        mujoco.mj_differentiatePos(self.model, out[: self.nv], 1.0, qpos, to_qpos)
        out[self.nv :] = to_qvel - qvel
        return out
