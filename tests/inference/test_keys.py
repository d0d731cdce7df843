"""No two random draws of inference have the same key."""

import types

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.inference.densities import mdnn
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.inference.train import _Member
from bayessim_mjx.keys import GOLDEN, branch

KEY = jax.random.PRNGKey(3)


def test_a_purpose_of_its_own_has_a_key_that_no_member_has():
    """As `fold_in(key, 1)` is the second of `split(key, 4)`."""
    members = {tuple(k) for k in np.asarray(jax.random.split(KEY, 1024)).tolist()}
    purposes = {tuple(np.asarray(branch(KEY, i)).tolist()) for i in range(16)}
    assert len(purposes) == 16 and not members & purposes
    assert tuple(np.asarray(jax.random.fold_in(KEY, 1)).tolist()) in members


def test_units_are_dropped_by_other_keys_in_every_layer_step_and_point_of_the_curve(monkeypatch):
    points, chunk, used = 20, 4, []
    data = types.SimpleNamespace(train=jnp.ones(12, bool), x=jnp.zeros((1, 12, 2)), own=None)
    member = types.SimpleNamespace(data=data, settings=InferenceSettings(batch=4), seen=lambda rows, turn: rows)
    monkeypatch.setattr(mdnn, "_noise", lambda key, shape: used.append(np.asarray(key)) or jnp.zeros(shape, jnp.uint32))
    monkeypatch.setattr(mdnn.jax.nn, "silu", lambda x: x)
    params = {"layers": [{"w": jnp.ones((2, 2)), "b": jnp.zeros(2)}] * 4}
    for i in range(-2, points):  # the trials of bases come before 0
        _, _, keys = _Member.batches(member, KEY + jnp.asarray(i, jnp.int32).astype(KEY.dtype) * GOLDEN, chunk)
        for key in keys:
            mdnn._hidden(params, jnp.ones((4, 2)), (key, jnp.float32(0.1)))
    assert len({tuple(key.tolist()) for key in used}) == len(used) == (points + 2) * chunk * 3
