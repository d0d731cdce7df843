"""Schedules of randomisation in the outer loop."""

import numpy as np

from bayessim_mjx import config, loop, registry, rl
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.loop import outer_loop

MASS = "task.randomization_params.actor_params.pendulum.rigid_body_properties.mass"
SETTINGS = [
    "env.numEnvs=8", "ppo.num_steps=4", "ppo.num_minibatches=2", "ppo.max_iterations=3", "ppo.hidden_actor=[8]",
    "ppo.hidden_critic=[8]", f"{MASS}.schedule=linear", f"{MASS}.schedule_steps=100",
]  # fmt: skip


def test_schedules_of_randomisation_go_on_from_round_to_round():
    """Their clock is the control steps that each world has trained for: 3 iterations of 4 steps in a round."""
    ramped = config.load("Pendulum", overrides=SETTINGS)
    parts = loop.make(ramped, registry.make("Pendulum", config=ramped))
    first, later = (outer_loop._new_policy(parts, i, Distribution.prior(parts.env.space)) for i in (0, 2))
    kept = rl.ppo.in_worlds_of(first, later)  # the policy of before, in new worlds
    for state, steps in ((first, 0), (later, 24), (kept, 24)):
        assert np.array_equal(state.env_states.info["nuisance"].course.clock, np.full(8, steps))
