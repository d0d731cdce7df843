"""Windows simulated without effects at any sub-step, by one compiled program; what start states can take away."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import programs
from bayessim_mjx.device import on_cores
from bayessim_mjx.diagnosis.fitting.quadratic import RULES, eliminate
from bayessim_mjx.diagnosis.fitting.windows import Batch, Windows
from bayessim_mjx.physics import Drive, Physics, begin, staggered, substep
from bayessim_mjx.physics.pushed import apart
from bayessim_mjx.physics.tangent import difference, integrate

Array = NDArray[np.float64]


# rad or rad/s, at least, of finite differences of single precision: the square root of its rounding
NUDGE = float(np.sqrt(np.finfo(np.float32).eps))


def held(cut: Windows) -> Windows:
    """Windows whose commands are held over the whole control step, as in training."""
    length, substeps = cut.batch.command.shape[1:3]
    rows = np.stack([cut.logs[r].ctrl[a : a + length] for r, a in zip(cut.log, cut.start, strict=True)])
    command = jnp.asarray(np.repeat(rows[:, :, None], substeps, 2), jnp.float32)
    return dataclasses.replace(cut, batch=cut.batch.replace(command=command))


@dataclass(frozen=True, eq=False)
class Case:
    """What windows are simulated with.

    Attributes:
        cut: the windows, with their commands.
        offsets: `[W, 2 nv]`, changes of the start states besides those that were fitted.
        theta: `[P]`, parameters; None: nominal.
        force: `[W, H, nv]`, generalised force that acts besides.
    """

    cut: Windows
    offsets: Array | None = None
    theta: Array | None = None
    force: Array | None = None


class Errors:
    """Windows without effects at any sub-step, by one compiled program: measured minus simulated, `[W, H, 2 nv]`.

    Args:
        cut: the windows, with commands for the coarsest sub-steps that are asked for; finest: the largest factor.
    """

    def __init__(self, physics: Physics, cut: Windows, finest: int) -> None:
        self.physics, self.cut, self.finest = physics, cut, finest
        self.first = cut.batch.command.shape[2] // physics.substeps
        self.theta = np.asarray(physics.space.nominal, np.float32)
        self.offsets: Array = np.zeros((len(cut), 2 * physics.mj_model.nv))  # of the measured start states
        self.seconds = 0.0  # that a case took of those simulated last
        self._moved: tuple[Array, Array] | None = None  # start states, and the derivatives there
        self._no_force = np.zeros((len(cut), cut.steps, physics.mj_model.nv), np.float32)
        axes = (0, 0, 0, None, None, None, None)
        precise = jax.default_matmul_precision("highest")(self._errors)
        self._run = programs.Kept(jax.vmap(precise, in_axes=axes), programs.traced_from(physics, "sub-steps"))

    def run(self, cut: Windows, factor: int, corrected: bool = True, offsets: Array | None = None) -> Array:
        """With the commands of `cut` at the sub-step h / factor; corrected: velocities lie half of that early."""
        return self.run_each([Case(cut, offsets)], factor, corrected)[0]

    def run_each(self, cases: Sequence[Case], factor: int, corrected: bool = True) -> Array:
        """Several cases, `[n, W, H, 2 nv]`, one on each core: together a window costs as much as apart."""
        h = np.float32(self.physics.mj_model.opt.timestep / factor)

        def one(case: Case) -> Array:
            count = case.cut.batch.command.shape[2]
            missing = [(0, 0), (0, 0), (0, self.finest * self.physics.substeps - count), (0, 0)]
            command = np.pad(np.asarray(case.cut.batch.command), missing)  # the past keeps its shape
            batch = self.cut.batch.replace(command=command)
            offsets = self.offsets if case.offsets is None else self.offsets + case.offsets
            force = self._no_force if case.force is None else np.asarray(case.force, np.float32)
            theta = np.asarray(self.theta if case.theta is None else case.theta, np.float32)
            given = np.asarray(offsets, np.float32), force, theta
            return np.asarray(self._run(batch, *given, count, h, np.float32(corrected)), np.float64)

        began = time.monotonic()
        found = np.stack(on_cores(one, cases))
        self.seconds = (time.monotonic() - began) / len(cases)
        return np.nan_to_num(found, nan=1e3, posinf=1e3, neginf=-1e3)

    def _errors(
        self,
        own: Batch,
        offset: jax.Array,
        force: jax.Array,
        theta: jax.Array,
        count: jax.Array,
        h: jax.Array,
        corrected: jax.Array,
    ) -> jax.Array:
        physics, nv = self.physics, self.physics.mj_model.nv
        world = begin(physics, theta, own.around)
        world = world.replace(qpos=integrate(physics.mj_model, world.qpos, offset[:nv]), qvel=world.qvel + offset[nv:])
        model = physics.model_of(world).tree_replace({"opt.timestep": h})
        early = 0.5 * corrected * h if staggered(physics.mj_model) else 0.0
        thetas = physics.split(world.theta)[1]  # of its own forces and its servos' gains

        def step(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
            (data, memory), (command, enabled, extra) = carry, row
            seen = {"qpos": data.qpos, "qvel": data.qvel}
            drive = Drive(extra, enabled, own.law)

            def sub(k: jax.Array, carry: tuple) -> tuple:
                return substep(physics, model, carry[0].replace(ctrl=command[k]), carry[1], thetas, seen, drive)

            data, memory = jax.lax.fori_loop(0, count, sub, (data, memory))
            return (data, memory), (data.qpos, data.qvel + early * data.qacc)

        start = physics.data_of(world), (world.memory, apart(physics, world.forces))
        _, (qpos, qvel) = jax.lax.scan(step, start, (own.command, own.enabled, force))
        error = jax.vmap(lambda a, b: difference(physics.mj_model, a, b))(own.qpos, qpos)
        return jnp.concatenate([error, own.qvel - qvel], axis=1)

    def columns(self, sigma: Array, here: Array | None = None) -> Array:
        """`[W, n, 2 nv]`, minus the derivatives of the whitened errors by the start states; here: the errors there."""
        if self._moved is None or self._moved[0] is not self.offsets:
            here = self.run(self.cut, self.first) if here is None else here
            nudges = np.diag(np.maximum(RULES.change * self.cut.spread, NUDGE))
            there = self.run_each([Case(self.cut, np.tile(n, (len(self.cut), 1))) for n in nudges], self.first)
            each = [(here - error) / n.max() for n, error in zip(nudges, there, strict=True)]
            self._moved = self.offsets, np.stack(each, -1)
        moved = self._moved[1] / sigma[:, None]
        return np.asarray(moved.reshape(len(moved), -1, moved.shape[-1]))

    def start(self, sigma: Array) -> None:
        """Fit the start states, until a step gains no more than a squared noise a window.

        Far from the measured motion the time step's error is another one.
        """
        here = self.run(self.cut, self.first)
        gained = np.inf
        while gained > len(self.cut):
            step = _step(here / sigma, self.columns(sigma, here), self.offsets, self.cut.spread)
            there = self.run(self.cut, self.first, offsets=step)
            before, after = (np.sum((error / sigma) ** 2, (1, 2)) for error in (here, there))
            better = after < before
            gained = np.sum((before - after)[better])
            if better.any():
                self.offsets = self.offsets + np.where(better[:, None], step, 0.0)
            here = np.where(better[:, None, None], there, here)

    def settler(self, sigma: Array) -> Callable[[Array], Array]:
        """Errors -> errors that no change of the start states takes away, by linearisation."""
        columns, spread = self.columns(sigma), self.cut.spread

        def settle(error: Array) -> Array:
            step = _step(error / sigma, columns, np.zeros_like(self.offsets), spread)
            moved = np.einsum("wns,ws->wn", columns, step).reshape(error.shape)
            return np.asarray((error / sigma - moved) * np.where(np.isfinite(sigma), sigma, 0.0))

        return settle


def _step(whitened: Array, columns: Array, offsets: Array, spread: Array) -> Array:
    """Best change of the start states `[W, 2 nv]`."""
    r = whitened.reshape(len(whitened), -1)
    nothing = np.zeros((*r.shape, 0))
    return eliminate(r, nothing, columns, offsets, spread)[1].step(nothing, np.zeros(0))
