"""Inverse dynamics of measured motion as a linear model: effort ~ masses, springs, armature, friction, tilt, offset.

The identification model of Gautier and Khalil (IDIM-LS): positions differentiated without phase, effort and model
filtered alike, least squares. Here with bounds, so that friction cannot stand in for a robot that is not there.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy.optimize import lsq_linear

from bayessim_mjx.diagnosis.logcheck import loads
from bayessim_mjx.diagnosis.logcheck.filtered_motion import Mask, Motion, lowpass
from bayessim_mjx.logs.log import Array

FACTOR = 2.0  # a body's mass and the actuator's gain may be wrong by this factor either way


def recursive(mj_model: mujoco.MjModel, moved: Motion, gravity: Array | None = None) -> Array:
    """M qacc + c [T, nv] without armature (recursive Newton-Euler); at rest in the field `gravity` if given."""
    model = copy.copy(mj_model)
    if gravity is not None:
        model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    out, row = np.zeros_like(moved.qvel), np.zeros(model.nv)
    for k in range(len(out)):
        data.qpos[:] = moved.qpos[k]
        if gravity is None:
            data.qvel[:], data.qacc[:] = moved.qvel[k], moved.qacc[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 1, row)
        out[k] = row
    return out


def _alone(mj_model: mujoco.MjModel, body: int) -> mujoco.MjModel:
    """The model with the mass and inertia of one body only."""
    model = copy.copy(mj_model)
    others = np.arange(model.nbody) != body
    model.body_mass[others] = 0.0
    model.body_inertia[others] = 0.0
    return model


def _point(mj_model: mujoco.MjModel, body: int, place: Array) -> mujoco.MjModel:
    """The model with nothing but 1 kg at a place [3] of one body, m from its centre of mass."""
    model = _alone(mj_model, body)
    model.body_mass[body] = 1.0
    model.body_inertia[body] = 0.0
    model.body_ipos[body] += place
    return model


def springs(mj_model: mujoco.MjModel, moved: Motion) -> Array:
    """[T, nv] effort that holds the model's own springs."""
    data = mujoco.MjData(mj_model)
    out = np.zeros_like(moved.qvel)
    for k, q in enumerate(moved.qpos):
        data.qpos[:] = q
        mujoco.mj_fwdPosition(mj_model, data)
        mujoco.mj_fwdVelocity(mj_model, data)
        out[k] = -data.qfrc_spring
    return out


@dataclass(frozen=True, eq=False)
class Dynamics:
    """The parts of a motion's inverse dynamics that belong to the model, each [T, nv] and filtered.

    Attributes:
        bodies: [B, T, nv], M qacc + c of each body alone, at nominal mass.
        weight: [T, nv], the part of their sum that is gravity.
        tilt: [2, T, nv], gravity of g along world x and y.
        spring: [T, nv].
        load: [P, T, nv], of 1 kg at some places of the last links; most: [P], kg that may be there. Empty where no
            load is thought of.
    """

    moved: Motion
    bodies: Array
    weight: Array
    tilt: Array
    spring: Array
    load: Array
    most: Array

    @classmethod
    def of(cls, mj_model: mujoco.MjModel, moved: Motion) -> Dynamics:
        heavy = [b for b in range(1, mj_model.nbody) if mj_model.body_mass[b] > 0]
        bodies = [recursive(_alone(mj_model, b), moved) for b in heavy]
        down = float(np.linalg.norm(mj_model.opt.gravity))
        tilt = [recursive(mj_model, moved, g * down) for g in np.eye(3)[:2]] if down > 0 else []
        still = [recursive(mj_model, moved, mj_model.opt.gravity), springs(mj_model, moved)]
        weight, spring = _smooth(moved, still)
        return cls(moved, _smooth(moved, bodies), weight, _smooth(moved, tilt), spring, _smooth(moved, []), np.zeros(0))

    def loaded(self, mj_model: mujoco.MjModel) -> Dynamics:
        """With loads that the model does not know: positive masses at and around the last links' centres of mass."""
        parts, most = [], []
        for body in last_links(mj_model):
            for place in loads.reach(mj_model, body) * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]):
                parts.append(recursive(_point(mj_model, body, place), self.moved))
                most.append(loads.weight(mj_model, body))
        return replace(self, load=_smooth(self.moved, parts), most=np.array(most))

    def nominal(self, mj_model: mujoco.MjModel) -> Array:
        """[T, nv] effort that the nominal model needs for this motion, its friction and damping included."""
        moved = self.moved
        losses = mj_model.dof_damping * moved.qvel + mj_model.dof_frictionloss * np.sign(moved.qvel)
        own = mj_model.dof_armature * moved.qacc + losses
        return self.bodies.sum(0) + self.spring + lowpass(own, moved.step, moved.cutoff)

    def columns(self, dof: int) -> Columns:
        """The linear model of the effort at one degree of freedom.

        Masses within FACTOR, springs and friction only with the sign of springs and friction, gravity tilted by up to
        0.3 rad, any offset.
        """
        moved, v = self.moved, self.moved.qvel[:, dof]
        slow = 0.02 * float(np.percentile(np.abs(v), 95)) + 1e-12
        travel = np.cumsum(v) * moved.step  # the joint's own position, also where qpos has another layout
        losses = np.stack([v, np.tanh(v / slow), v * np.abs(v), moved.qacc[:, dof]], 1)
        losses = lowpass(losses, moved.step, moved.cutoff).T
        parts = [p for p in (*self.bodies[:, :, dof], self.spring[:, dof]) if np.abs(p).max() > 1e-9]
        tilt = [p for p in self.tilt[:, :, dof] if np.abs(p).max() > 1e-9]
        felt = [i for i, p in enumerate(self.load[:, :, dof]) if np.abs(p).max() > 1e-9]
        blocks: list[tuple[Any, float, float]] = [
            ([np.ones(len(v))], -np.inf, np.inf),
            (losses, 0.0, np.inf),
            ([travel - travel.mean()], 0.0, np.inf),
            (parts, 1.0 / FACTOR, FACTOR),
            (tilt, -0.3, 0.3),
            *(([self.load[i, :, dof]], 0.0, float(self.most[i])) for i in felt),
        ]
        return Columns(
            np.stack([c for block, _, _ in blocks for c in block], 1),
            np.array([low for block, low, _ in blocks for _ in block]),
            np.array([high for block, _, high in blocks for _ in block]),
            slice(5 + 1, 5 + 1 + len(parts)),
        )


def _smooth(moved: Motion, parts: list[Array]) -> Array:
    """[P, T, nv], filtered as the motion is."""
    return np.array([lowpass(p, moved.step, moved.cutoff) for p in parts]).reshape(-1, *moved.qvel.shape)


def last_links(mj_model: mujoco.MjModel) -> list[int]:
    """Bodies with joints that carry no further joints."""
    jointed = np.flatnonzero(mj_model.body_jntnum)
    above = {int(mj_model.body_weldid[mj_model.body_parentid[b]]) for b in jointed}
    return [int(b) for b in jointed if int(b) not in above]


@dataclass(frozen=True, eq=False)
class Columns:
    """Linear model of one joint's effort, x [T, K] c with low <= c <= high."""

    x: Array
    low: Array
    high: Array
    rigid: slice  # the model's own bodies and springs, which have a scale

    def friction(self) -> Columns:
        """Offset and friction alone, as if the joint carried nothing."""
        return Columns(self.x[:, :4], self.low[:4], self.high[:4], slice(0, 0))

    def explained(self, efforts: Array, rows: Mask, scaled: bool = True) -> Array:
        """[L] share of the variance of efforts [L, T] over the rows [T] that the bounded model explains, or below zero.

        scaled: the effort's unit is the model's; otherwise every scale of the effort is tried.
        """
        y, x = efforts[:, rows], self.x[rows]
        size = np.linalg.norm(x, axis=0) + 1e-12
        # a bounded fit of R c = Q'y is that of X c = y
        q, r = np.linalg.qr(x / size)
        bounds = (self.low * size, self.high * size)
        body = float(np.linalg.norm(x[:, self.rigid].sum(1)))

        def one(signal: Array) -> float:
            target = q.T @ signal
            norm = max(float(np.linalg.norm(signal)), 1e-300)
            tried = np.ones(1) if scaled or body == 0 else body / norm * np.geomspace(0.1, 10.0, 9)
            fits = [2.0 * lsq_linear(r, s * target, bounds=bounds, method="bvls").cost / s**2 for s in tried]
            left = norm**2 - float(target @ target) + float(min(fits))
            return 1.0 - left / max(float(np.sum((signal - signal.mean()) ** 2)), 1e-300)

        return np.array([one(signal) for signal in y])
