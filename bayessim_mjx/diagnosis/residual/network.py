"""A small network for a missing force: one hidden layer for each joint, trained through the simulator's own columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bayessim_mjx.diagnosis.fitting.quadratic import solve
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regression import Regression

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """Of the network and its training; not tuned."""

    hidden: int = 6  # neurons for each joint
    seeds: int = 2  # networks whose forces are averaged, so that no single draw of first weights counts
    iterations: int = 40
    spread: tuple[float, float] = (1.5, 0.3)  # prior standard deviations of weights into and out of the hidden layer
    limit: float = 4.0  # standard deviations at which inputs are clipped: no extrapolation


SIZES = Sizes()


def held_out(problem: Regression, fold: NDArray[np.int64]) -> Array:
    """Costs `[W]` of windows under the networks trained without their fold."""
    inputs = _inputs(problem.inputs)
    out = np.zeros(len(fold))
    for name in np.unique(fold):
        train, test = fold != name, fold == name
        trained = [_trained(problem, inputs, train, seed) for seed in range(SIZES.seeds)]
        force = np.mean([_nodes(problem, _force(weights, inputs[:, test])[0]) for weights, _ in trained], 0)
        step = np.mean([p for _, p in trained], 0)
        both = np.concatenate([np.broadcast_to(step, (test.sum(), problem.k)), force], 1)
        out[test] = problem.q_of(test).at(both)
    return out


def _inputs(inputs: Inputs) -> Array:
    """`[nv, W, H, I]`: position, speed, effort and past effort of the joint, position and speed of all others."""
    own = [inputs.position, np.tanh(inputs.speed / (0.1 * inputs.speed_scale)), inputs.speed, inputs.effort]
    own += [inputs.past[..., 0], inputs.past[..., 1]]
    nv = inputs.position.shape[2]
    others = [np.stack([np.delete(x, v, 2) for v in range(nv)], 2) for x in (inputs.position, inputs.speed)]
    z = np.concatenate([np.stack(own, 3), *others], 3)
    mean, sd = z.mean((0, 1)), z.std((0, 1))
    z = np.clip((z - mean) / np.where(sd > 1e-12, sd, np.inf), -SIZES.limit, SIZES.limit)
    z = np.concatenate([z, np.ones((*z.shape[:3], 1))], 3)
    return np.ascontiguousarray(np.moveaxis(z, 2, 0))


def _force(weights: tuple[Array, Array], z: Array) -> tuple[Array, Array]:
    """(force `[nv, W, H]` in units of the joints' scale, hidden layer `[nv, W, H, h]`) of inputs `[nv, W, H, I]`."""
    into, out = weights  # [nv, I, h], [nv, h + 1]
    hidden = np.tanh(z @ into[:, None])
    return (hidden @ out[:, None, :-1, None])[..., 0] + out[:, None, -1:], hidden


def _nodes(problem: Regression, force: Array) -> Array:
    """`[W, nv m]`, N m or N at the nodes of the columns, of a force `[nv, W, H]` in units of the joints' scale."""
    at_nodes = force @ problem.average * problem.scale[:, None, None]
    return np.asarray(np.moveaxis(at_nodes, 0, 1).reshape(force.shape[1], -1))


def _trained(
    problem: Regression, inputs: Array, train: NDArray[np.bool_], seed: int
) -> tuple[tuple[Array, Array], Array]:
    """((weights into, weights out), parameter step) at the most probable weights, misfits as large as the gap."""
    z, q, weight = inputs[:, train], problem.q_of(train), problem.fit.weight[train]
    k, (nv, count, _, width) = problem.k, z.shape
    shapes = (nv, width, SIZES.hidden), (nv, SIZES.hidden + 1)
    cut = int(np.prod(shapes[0]))
    spread = np.concatenate([np.full(cut, SIZES.spread[0]), np.full(int(np.prod(shapes[1])), SIZES.spread[1])])
    doubt = max(float(weight @ q.c), 1e-300) / problem.fitter.numbers
    Spp, gp = np.einsum("w,wij->ij", weight, q.S[:, :k, :k]), weight @ q.g[:, :k]
    Spf = weight[:, None, None] * q.S[:, :k, k:]

    def unpacked(x: Array) -> tuple[Array, Array]:
        return x[:cut].reshape(shapes[0]), x[cut:].reshape(shapes[1])

    def step_of(f: Array) -> Array:
        if not k:
            return np.zeros(0)
        pull = gp + problem.pull - np.sum(Spf @ f[:, :, None], 0)[:, 0]
        return solve(Spp + np.diag(problem.precision), pull, problem.low, problem.high)

    def cost(x: Array) -> tuple[float, Array]:
        into, out = unpacked(x)
        force, hidden = _force((into, out), z)
        f = _nodes(problem, force)
        full = np.concatenate([np.broadcast_to(step_of(f), (count, k)), f], 1)
        pulled = (q.S @ full[:, :, None])[..., 0]
        each = q.c + np.sum(full * (pulled - 2 * q.g), 1)
        slope = 2 * weight[:, None] * (pulled - q.g)[:, k:]  # at the best step, whose own slope is none
        by_node = np.moveaxis(slope.reshape(count, nv, -1), 1, 0) * problem.scale[:, None, None]
        by_step = (by_node @ problem.average.T)[..., None]
        # window by window: products of large matrices would call threads that wait for each other
        to_out = np.concatenate([np.sum(hidden * by_step, (1, 2)), np.sum(by_step, (1, 2))], 1)
        inner = by_step * out[:, None, None, :-1] * (1 - hidden**2)
        to_into = np.sum(np.moveaxis(z, 2, 3) @ inner, 1)
        gradient = np.concatenate([to_into.ravel(), to_out.ravel()]) / doubt + 2 * x / spread**2
        return float(weight @ each) / doubt + float(np.sum((x / spread) ** 2)), gradient

    start = np.random.default_rng(seed).normal(size=len(spread)) * spread * (np.arange(len(spread)) < cut)
    found = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": SIZES.iterations})
    weights = unpacked(found.x)
    return weights, step_of(_nodes(problem, _force(weights, z)[0]))
