"""Every feature of every summary has a name of its own that says what it is."""

import jax
import jax.numpy as jnp
import pytest

from bayessim_mjx.inference import summarizers
from bayessim_mjx.inference.summaries.learned import Embedding

STATES, ACTIONS, STEPS = ("angle", "speed"), ("torque",), 4


@pytest.mark.parametrize(
    "summary",
    [
        "start",
        "start_2",
        "waypts_3",
        "corr",
        "corr_2",
        "corrdiff",
        "corrdiff_1",
        "signatory_3",
        "logsignature",
        "learned",
    ],
)
def test_there_is_one_for_each(summary):
    names = summarizers.feature_names(summary, STEPS, STATES, ACTIONS)
    assert len(names) == summarizers.size(summarizers.get(summary), STEPS, len(STATES), len(ACTIONS))
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("summary", ["start", "start_2", "waypts_3", "corr_1", "corrdiff_1", "signatory_2", "learned"])
def test_only_what_a_name_speaks_of_enters_the_feature(summary):
    """A feature changes with torque, speed ... exactly where its name has it."""
    summarize = summarizers.get(summary)
    key_s, key_a = jax.random.split(jax.random.PRNGKey(0))
    states, actions = jax.random.normal(key_s, (STEPS + 1, 2)), jax.random.normal(key_a, (STEPS, 1))
    of_states, of_actions = jax.jit(jax.jacobian(summarize, argnums=(0, 1)))(states, actions)
    for i, name in enumerate(summarizers.feature_names(summary, STEPS, STATES, ACTIONS)):
        for channel, slope in (("angle", of_states[i, :, 0]), ("speed", of_states[i, :, 1]), ("torque", of_actions[i])):
            assert (channel in name) == bool(jnp.any(jnp.abs(slope) > 1e-6)), (name, channel)
        if " at step " in name and "change" not in name:
            step = int(name.rpartition(" ")[2])
            slopes = jnp.abs(of_actions[i, :, 0] if "torque" in name else of_states[i].sum(-1))
            assert int(jnp.argmax(slopes)) == step


def test_lags_are_told_apart():
    names = summarizers.feature_names("corr_1", STEPS, STATES, ACTIONS)
    assert names[:4] == tuple(f"corr({s}, torque) lag {lag}" for lag in (0, 1) for s in STATES)
    assert summarizers.feature_names("corr", STEPS, STATES, ACTIONS)[0] == "corr(angle, torque)"
    summarize = summarizers.get("corr_1")
    states = jnp.zeros((STEPS + 1, 2)).at[2, 0].set(1.0)
    actions = jnp.zeros((STEPS, 1)).at[1, 0].set(1.0)  # the state one step later
    assert summarize(states, actions)[:4].tolist() == [0.0, 0.0, 1.0, 0.0]


def test_the_learned_embedding_takes_rows_of_that_many():
    names = summarizers.feature_names("learned", STEPS, STATES, ACTIONS)
    assert len(names) == Embedding(STEPS, len(STATES), len(ACTIONS), window=3).row_size
