"""Classifier two-sample test (Lopez-Paz and Oquab 2017): 0.5 = samples cannot be told apart, 1 = always."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

FOLDS, EPOCHS, BATCH, HELD = 5, 80, 200, 0.1


def c2st(a: np.ndarray, b: np.ndarray, seed: int = 0) -> float:
    """Accuracy of a classifier of a [n, d] against b [n, d], 5-fold; all folds trained side by side.

    sbibm's recipe (two hidden layers of 10 d ReLU units, Adam, z-scored by a), with the weights best on a tenth
    of the training rows instead of a fixed number of steps.
    """
    n = min(len(a), len(b))
    mean, sd = a.mean(0), a.std(0)
    rng = np.random.default_rng(seed)
    rows = np.concatenate([(a[:n] - mean) / sd, (b[:n] - mean) / sd]).astype(np.float32)
    labels = np.repeat(np.float32([0, 1]), n)
    order = rng.permutation(2 * n)[: 2 * n // FOLDS * FOLDS].reshape(FOLDS, -1)
    test = order
    rest = np.stack([np.concatenate([order[j] for j in range(FOLDS) if j != i]) for i in range(FOLDS)])
    held = int(HELD * rest.shape[1])
    keys = jax.random.split(jax.random.PRNGKey(seed), FOLDS)
    return float(np.mean(_folds(jnp.asarray(rows), jnp.asarray(labels), keys, rest[:, held:], rest[:, :held], test)))


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0, 0, 0, 0))
def _folds(x: Array, y: Array, key: Array, train: Array, held: Array, test: Array) -> Array:
    width = 10 * x.shape[1]
    sizes = (x.shape[1], width, width, 1)
    keys = jax.random.split(key, 4)
    params = [
        (jax.random.normal(k, (n, m)) * (2 / n) ** 0.5, jnp.zeros(m))
        for k, n, m in zip(keys, sizes, sizes[1:], strict=False)
    ]
    optimiser = optax.adam(1e-3)

    def logit(params: list, rows: Array) -> Array:
        h = x[rows]
        for w, b in params[:-1]:
            h = jax.nn.relu(h @ w + b)
        return (h @ params[-1][0] + params[-1][1])[:, 0]

    def loss(params: list, rows: Array) -> Array:
        return jnp.mean(optax.sigmoid_binary_cross_entropy(logit(params, rows), y[rows]))

    def step(carry: tuple, rows: Array) -> tuple[tuple, None]:
        params, state = carry
        updates, state = optimiser.update(jax.grad(loss)(params, rows), state)
        return (optax.apply_updates(params, updates), state), None

    def epoch(carry: tuple, key: Array) -> tuple[tuple, None]:
        inner, best = carry
        steps = train.shape[0] // BATCH
        rows = jax.random.permutation(key, train)[: steps * BATCH].reshape(steps, BATCH)
        inner, _ = jax.lax.scan(step, inner, rows)
        new = (loss(inner[0], held), inner[0])
        best = jax.tree.map(lambda a, b: jnp.where(new[0] < best[0], a, b), new, best)
        return (inner, best), None

    start = (params, optimiser.init(params)), (loss(params, held), params)
    (_, (_, params)), _ = jax.lax.scan(epoch, start, jax.random.split(keys[3], EPOCHS))
    return jnp.mean((logit(params, test) > 0) == (y[test] > 0.5))
