"""A posterior reaches every library's worlds: episodes begin with its theta, whichever wrapper makes them."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from tests.wrappers.toys import Counter

ENV, WORLDS = Counter(), 4  # it shows its theta as the third number
KEYS = jax.random.split(jax.random.PRNGKey(0), WORLDS)


def wrapper(name: str, needs: str) -> Any:
    pytest.importorskip(needs)
    return importlib.import_module(f"bayessim_mjx.wrappers.{name}")


def of_brax(domain: Path) -> Any:
    from bayessim_mjx.wrappers import brax, fresh

    return fresh.wrap(brax.ours(ENV, domain)).reset(KEYS).obs["policy"]


def of_playground(domain: Path) -> Any:
    return jax.vmap(wrapper("playground", "mujoco_playground").make(ENV, domain).reset)(KEYS).obs["state"]


def of_rl_games(domain: Path) -> Any:
    ours = wrapper("rl_games", "rl_games")
    from rl_games.common import vecenv

    ours.register("posterior", ENV, domain)
    return vecenv.create_vec_env("posterior", WORLDS).reset()["obs"]


def of_gymnasium(domain: Path) -> Any:
    from bayessim_mjx.wrappers.gymnasium import GymnasiumVectorEnv
    from bayessim_mjx.wrappers.worlds import domain_of

    return GymnasiumVectorEnv(ENV, WORLDS, domain_of(ENV, domain)).reset(seed=0)[0]


FIRST: dict[str, Callable[[Path], Any]] = {
    "gymnasium": of_gymnasium,
    "brax": of_brax,
    "sb3": lambda domain: wrapper("sb3", "stable_baselines3").make(ENV, WORLDS, domain).reset(),
    "rsl_rl": lambda domain: wrapper("rsl_rl", "rsl_rl").make(ENV, WORLDS, domain).reset()[0]["policy"],
    "skrl, JAX": lambda domain: wrapper("skrl", "skrl").make(ENV, WORLDS, domain).reset()[0],
    "skrl, PyTorch": lambda domain: wrapper("skrl", "skrl").make(ENV, WORLDS, domain, library="torch").reset()[0],
    "rl_games": of_rl_games,
    "playground": of_playground,
}


@pytest.mark.parametrize("library", FIRST)
def test_first_episodes_have_the_theta_of_a_posterior(library: str, tmp_path: Path) -> None:
    narrow = Distribution.gaussian(ENV.space, jnp.array([3.0]), jnp.array([0.02]))
    seen = np.asarray(FIRST[library](narrow.save(tmp_path / "posterior.npz")))
    assert seen.shape == (WORLDS, 3) and len(np.unique(seen[:, 2])) == WORLDS
    np.testing.assert_allclose(seen[:, 2], 3.0, atol=0.1)
