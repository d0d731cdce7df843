"""Policies in closed loop on the simulator as it was, on the corrected one and on the surrogate real.

Four kinds of policies, all trained alike: `nominal` on the simulator as it was, `corrected` on the corrected one with
what the diagnosis knows as randomisation, `wide` on the simulator as it was with its known parameters randomised widely
and `oracle` on the surrogate real itself. Evaluations use the same initial states and random numbers everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import rl
from bayessim_mjx.closed_loop.measures import standard_error
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.simulator import Simulator
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.keys import branch
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics, controllers
from bayessim_mjx.rl import Policy

if TYPE_CHECKING:
    from bayessim_mjx.env import Task

Array = NDArray[np.float64]
WIDE = 0.5  # of the nominal value, either way
CHECKPOINTS = 8  # policies of one training that are kept and ranked, besides the untrained one
REPLAYED = 4.0  # s of each log
TOGETHER = CHECKPOINTS + 1  # policies evaluated in one program on a CPU
ON_ACCELERATORS = 48  # and where a step takes as long for a few of them
DRAWN = "drawn"
Plan = tuple[Policy, Any]  # a policy and the theta it plays on (None: nominal, DRAWN: the environment's priors)


@dataclass(frozen=True, eq=False)
class Simulators:
    """The task on each physics.

    Attributes:
        nominal: as it was; its space holds the known parameters, uniform within +-50 %.
        corrected: at the identified values; its space has the diagnosis's priors.
        real: the surrogate, nominal at the hidden values; None where there are only logs.
    """

    nominal: Task
    corrected: Task
    real: Task | None

    def training(self, role: str) -> tuple[Task, Distribution | None]:
        """(environment, what its physics is drawn from) for the policies of a role."""
        if role == "oracle":
            assert self.real is not None
            return self.real, None
        env = self.corrected if role == "corrected" else self.nominal
        return env, Distribution.prior(env.space) if role != "nominal" and len(env.space) else None

    @property
    def roles(self) -> tuple[str, ...]:
        return ("nominal", "corrected", "wide", "oracle") if self.real is not None else ("nominal", "corrected")


def wide(space: ParameterSpace) -> ParameterSpace:
    """Make the known parameters uniform within +-50 % of nominal values (in their own ranges where those are 0)."""
    return ParameterSpace(_wide(p) for p in space.parameters)


def _wide(p: Parameter) -> Parameter:
    ends = sorted((1 + side * WIDE) * p.nominal for side in (-1, 1))
    low, high = ends if p.nominal else (p.low, p.high)
    return replace(p, low=low, high=high, prior="uniform", mean=None, sd=None)


def marks(iterations: int) -> list[int]:
    """PPO iterations after which a policy is kept: 0, ..., `iterations`."""
    return sorted({round(iterations * i / CHECKPOINTS) for i in range(CHECKPOINTS + 1)})


def train(
    env: Task,
    ppo: PPOConfig,
    key: jax.Array,
    domain: Distribution | None,
    at: Sequence[int],
    keep: Callable[[int, Policy], Any],
    progress: Callable[[dict, Any], None] | None = None,
) -> None:
    """PPO from scratch.

    Args:
        env, ppo, key, domain: as `rl.start` takes them.
        at: iterations, increasing, at which the policy is kept; the last one ends the training.
        keep: called with (iteration, policy).
        progress: called with (metrics, state) at every log interval.
    """
    state, done = rl.start(env, ppo, key, domain), 0
    for mark in at:
        if mark > done:
            state, _ = rl.run(env, ppo, state, domain, iterations=mark - done, progress=progress)
            done = mark
        keep(mark, rl.policy_of(state))


@dataclass(frozen=True, eq=False)
class Judge:
    """Evaluates policies: `episodes` whole ones each, the same initial states everywhere."""

    simulators: Simulators
    episodes: int
    key: jax.Array

    def returns(self, env: Task, plans: Sequence[Plan]) -> list[Array]:
        """Compute returns `[episodes]` of each plan: many in one program, which is compiled once for an environment."""
        out: dict[int, Array] = {}
        most = TOGETHER if jax.default_backend() == "cpu" else ON_ACCELERATORS
        for alike in _alike(plans):
            for some in (alike[k : k + most] for k in range(0, len(alike), most)):
                full = [plans[i] for i in some] + [plans[some[-1]]] * (most - len(some))
                thetas = jnp.stack([self._thetas(env, theta) for _, theta in full])
                found = rl.evaluate_together(env, [policy for policy, _ in full], self.key, thetas)["return"]
                out |= dict(zip(some, np.asarray(found, np.float64), strict=False))
        return [out[i] for i in range(len(plans))]

    def _thetas(self, env: Task, theta: Any) -> jax.Array:
        """`[episodes, d]`: nominal (None), drawn from the environment's priors ("drawn"), or one theta for all."""
        if isinstance(theta, str):
            return Distribution.prior(env.space).sample(branch(self.key, 1), self.episodes)
        theta = env.space.nominal if theta is None else theta
        return jnp.tile(jnp.asarray(theta, jnp.float32), (self.episodes, 1))

    def everywhere(self, policies: Sequence[Policy]) -> list[dict[str, Array]]:
        """Per policy, returns on each simulator; "posterior": the corrected one over what the diagnosis leaves open."""
        s = self.simulators
        places: dict[str, tuple[Task, Any]] = {"nominal": (s.nominal, None), "corrected": (s.corrected, None)}
        if len(s.corrected.space):
            places["posterior"] = (s.corrected, DRAWN)
        if s.real is not None:
            places["real"] = (s.real, None)
        found = {name: self.returns(env, [(p, theta) for p in policies]) for name, (env, theta) in places.items()}
        return [{name: each[i] for name, each in found.items()} for i in range(len(policies))]

    def at_home(self, role: str, policies: Sequence[Policy]) -> list[float]:
        """Mean returns where policies of this role are trained, with other random numbers than the reported ones."""
        env, domain = self.simulators.training(role)
        other = replace(self, key=branch(self.key, 2))
        plans: list[Plan] = [(p, None if domain is None else DRAWN) for p in policies]
        return [float(x.mean()) for x in other.returns(env, plans)]

    def one_by_one(self, policies: Sequence[Policy]) -> list[list[dict[str, Any]]]:
        """Per policy, effect and place: what it changes of the return, beside the others ("last") and "alone".

        Both, because an effect that ends every episode at once hides all others.
        """
        env = self.simulators.corrected
        full, neutral = env.space.nominal, env.physics.neutral
        labels = places(env.physics)
        thetas = [full, neutral]
        for own in labels.values():
            thetas += [np.where(own, neutral, full), np.where(own, full, neutral)]
        found = iter(self.returns(env, [(p, theta) for p in policies for theta in thetas]))
        out = []
        for _ in policies:
            with_all, with_none, rows = next(found), next(found), []
            for name, where in labels:
                changed = {"last": with_all - next(found), "alone": next(found) - with_none}
                changes = {k: {"mean": float(x.mean()), "se": standard_error(x)} for k, x in changed.items()}
                rows.append({"effect": name, "where": where, **changes})
            out.append(rows)
        return out


def _alike(plans: Sequence[Plan]) -> list[list[int]]:
    """Group the indices of the plans by networks of the same form."""
    groups: dict[Any, list[int]] = {}
    for i, (policy, _) in enumerate(plans):
        leaves, form = jax.tree.flatten(policy)
        groups.setdefault((form, tuple(np.shape(x) for x in leaves)), []).append(i)
    return list(groups.values())


def places(physics: Physics) -> dict[tuple[str, str], NDArray[np.bool_]]:
    """{(effect, where): which entries of theta are its parameters}, `[d]` each."""
    index = np.arange(len(physics.space))
    return {(b.effect.name, b.place): (index >= b.start) & (index < b.stop) for b in physics.blocks if b.effect}


def replay(logs: Sequence[Log], nominal: Physics, corrected: Physics) -> dict[str, Any] | None:
    """Replay declared controllers in closed loop from the logs' first states; error of position, root mean square.

    Returns:
        {"seconds", "logs", "error": {dof: {"nominal", "corrected"}}} in rad or m; None where no log declares a law.

    Raises:
        UserError: the logs are too short.
    """
    declared = [log for log in logs if controllers.declared(log.metadata)]
    if not declared:
        return None
    dt = nominal.dt
    length = int(min(REPLAYED, *(log.time[-1] - log.time[0] for log in declared)) / dt) - 1
    if length < 2:
        raise UserError(f"--real: the shortest log with a controller holds {length + 1} control steps of {dt:.3g} s")
    rms = {}
    for name, physics in (("nominal", nominal), ("corrected", corrected)):
        starts = [(i, 0) for i in range(len(declared))]
        cut = windows.cut(declared, physics.mj_model, dt, physics.substeps, length, limit=len(starts), starts=starts)
        error = Simulator(physics, cut, lanes=len(cut)).run(physics.space.nominal[None].astype(np.float64))
        rms[name] = np.sqrt(np.mean(error[0, ..., : physics.mj_model.nv] ** 2, axis=(0, 1)))
    names = Channels.of(nominal.mj_model).qvel
    errors = {n: {s: float(rms[s][i]) for s in rms} for i, n in enumerate(names)}
    return {"seconds": length * dt, "logs": [log.name for log in declared], "error": errors}
