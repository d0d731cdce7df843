"""PPO as `init` and one jitted `update`: new worlds, collection, statistics, advantages once, epochs of minibatches."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bayessim_mjx import memory
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import MirrorMap
from bayessim_mjx.physics.nuisance import starting
from bayessim_mjx.rl import (
    episodes,
    losses,
    networks,
    normalise,
    privileged,
    recurrent,
    rnd,
    segments,
    sharding,
    symmetry,
)
from bayessim_mjx.rl.gae import gae
from bayessim_mjx.rl.networks import Policy
from bayessim_mjx.rl.rnd import RND
from bayessim_mjx.rl.sharding import EVERYWHERE, FIRST, SECOND
from bayessim_mjx.rollout import collect, ring, strong, traced

if TYPE_CHECKING:
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.env import Env, State

Update = Callable[..., Any]


@struct.dataclass
class TrainState:
    """All that the next update needs, as plain arrays: saving and restoring it resumes training bit for bit (CPU)."""

    params: networks.Params
    opt_state: Any  # Adam over the flattened parameters
    normalizer: dict[str, normalise.Moments]  # by observation group
    learning_rate: jax.Array  # []
    env_states: Any  # State with leading axis num_envs
    episodes: episodes.Episodes
    key: jax.Array  # [2] uint32
    iteration: jax.Array  # [] int32
    env_steps: jax.Array  # [] uint32
    config: PPOConfig = struct.field(pytree_node=False)  # that the networks were made with
    rnd: RND | None = None  # None where config.rnd is
    mesh: Mesh | None = struct.field(pytree_node=False, default=None)  # of the devices that share the worlds


def critic_group(env: Env) -> str:
    """The observation group that the critic sees: "critic" where the environment has one, else "policy"."""
    return "critic" if "critic" in env.observation_size else "policy"


def _for_learner(env: Env, config: PPOConfig) -> Env:
    """The environment as the learner sees it."""
    return privileged.for_critic(env) if config.critic_theta else env


def _mirrors(env: Env, config: PPOConfig) -> tuple[MirrorMap, ...]:
    """The mirror maps in use, checked to know all that the networks see."""
    return symmetry.mirrors(env, config, {"policy", critic_group(env)})


def layout(state: TrainState) -> TrainState:
    """Where the state's arrays lie: what belongs to worlds with them, all else on every device."""
    everywhere: Any = jax.tree.map(lambda _: EVERYWHERE, state)

    def counted(counters: Any) -> Any:
        return dataclasses.replace(counters, running_return=FIRST, running_length=FIRST, partial=FIRST)

    novel = everywhere.rnd
    return everywhere.replace(
        env_states=jax.tree.map(lambda _: FIRST, state.env_states),
        episodes=counted(everywhere.episodes),
        rnd=None if novel is None else novel.replace(discounted=FIRST, episodes=counted(novel.episodes)),
    )


def policy_of(state: TrainState) -> Policy:
    """The policy of a training state, with its normaliser; of several devices, as host arrays."""
    config = state.config
    policy = Policy(
        actor=state.params["actor"],
        normalizer=state.normalizer["policy"],
        activation=config.activation,
        normalize=config.normalize_observations,
        action_clip=config.action_clip,
        squash=config.action_bound == "tanh",
    )
    return sharding.at_home(policy)


def in_worlds_of(state: TrainState, other: TrainState) -> TrainState:
    """The learner of `state` in the worlds of `other`, with the sums that run over these worlds."""
    novel = state.rnd
    if novel is not None:
        assert other.rnd is not None
        novel = dataclasses.replace(novel, discounted=other.rnd.discounted, episodes=other.rnd.episodes)
    return dataclasses.replace(state, env_states=other.env_states, episodes=other.episodes, rnd=novel)


def _reset(
    env: Env, key: jax.Array, domain: Distribution | None, worlds: int, mesh: Mesh | None = None, clock: Any = 0
) -> State:
    """Fresh episodes in `worlds` worlds with theta from the domain (None: nominal), `clock` steps into training."""
    theta_key, reset_key = jax.random.split(key)
    if domain is None:
        thetas = jnp.tile(jnp.asarray(env.space.nominal, jnp.float32), (worlds, 1))
    else:
        thetas = domain.sample(theta_key, worlds)
    given: tuple[Any, ...] = (jax.random.split(reset_key, worlds), thetas)
    if getattr(env, "nuisance", None) is not None:
        given = (given[0], env.space.scheduled(thetas, clock), starting(clock, worlds))
    reset = sharding.local(jax.vmap(traced(env.reset)), mesh, (FIRST,) * len(given), FIRST)
    return reset(*given)


def _clock(env: Env, env_states: State) -> jax.Array:
    """Control steps of each world since training began; 0 where nothing goes by them."""
    if getattr(env, "nuisance", None) is None:
        return jnp.int32(0)
    return env_states.info["nuisance"].course.clock.max()


def _stagger(key: jax.Array, state: State, episode_length: int) -> tuple[State, jax.Array]:
    """First episodes' clocks spread out, so that time limits do not come all at once; and which are late, [N]."""
    steps = jax.random.randint(key, state.reward.shape, 0, episode_length).astype(state.info["steps"].dtype)
    world = state.pipeline_state
    if "steps" in getattr(world, "task", {}):  # our tasks count in the world, the others in info
        world = world.replace(task={**world.task, "steps": steps})
    state = dataclasses.replace(state, pipeline_state=world, info={**state.info, "steps": steps})
    return state, (steps > 0).astype(jnp.float32)


def _check_shares(config: PPOConfig, mesh: Mesh | None) -> None:
    """Refuse numbers of worlds and minibatches that the devices cannot share evenly."""
    devices, worlds = sharding.count(mesh), config.num_envs
    if worlds % (devices * ring(worlds)):
        raise UserError(
            f"ppo.num_envs = {worlds} cannot be shared evenly by {devices} devices; give a multiple of {32 * devices}"
        )
    part = (worlds if config.memory else worlds * config.num_steps // max(1, config.segment)) // config.num_minibatches
    if part % devices:
        what = "sequences" if config.memory else "segments" if config.segment else "transitions"
        raise UserError(
            f"ppo.num_minibatches = {config.num_minibatches} makes minibatches of {part} {what}, which {devices} "
            "devices cannot share evenly"
        )


def _check_memory(env: Env, config: PPOConfig, mesh: Mesh | None) -> None:
    """Refuse worlds whose states (and as many resets) and one collection do not fit into a device's memory."""
    key, theta = jax.random.PRNGKey(0), np.asarray(env.space.nominal, np.float32)
    world = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(traced(env.reset), key, theta)))
    seen = sum(env.observation_size[group][0] for group in {"policy", critic_group(env)})
    # observations before and after; actions, rewards, values ...; the critic judges all steps at once
    step = 4 * (2 * seen + 3 * env.action_size + 8 + max(config.hidden_critic, default=0))
    share = config.num_envs / sharding.count(mesh)
    what = f"ppo.num_envs = {config.num_envs} (env.numEnvs) worlds, ppo.num_steps = {config.num_steps}"
    room = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    memory.refuse([(what, share * (2 * world + config.num_steps * step))], room)


def init(
    env: Env,
    config: PPOConfig,
    key: jax.Array,
    domain: Distribution | None = None,
    mesh: Mesh | None = None,
    clock: int = 0,
) -> TrainState:
    """The state before the first update; domain None trains at the nominal theta.

    clock: control steps that each world has trained before, which schedules of randomisation go by.
    mesh: the devices that share the worlds, see `device.mesh`; None: the default device. Results differ by rounding.
    """
    check(env, config, mesh)
    program = _init(_for_learner(env, config), config, mesh)
    given = (key, domain, np.int32(clock))
    return program(*(given if mesh is None else sharding.agreed(given)))


def outline(env: Env, config: PPOConfig, domain: Distribution | None = None, mesh: Mesh | None = None) -> TrainState:
    """Shapes, types and layout of what `init` returns."""
    shapes = jax.eval_shape(_init(_for_learner(env, config), config, mesh), jax.random.PRNGKey(0), domain, np.int32(0))
    if mesh is None:
        return shapes

    def laid_out(x: jax.ShapeDtypeStruct, spec: PartitionSpec) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=NamedSharding(mesh, spec))

    return jax.tree.map(laid_out, shapes, layout(shapes))


def check(env: Env, config: PPOConfig, mesh: Mesh | None = None) -> None:
    """Refuse what does not go together."""
    if "policy" not in env.observation_size:
        raise UserError(f"observation groups {sorted(env.observation_size)}: a policy needs the group 'policy'")
    if config.policy_theta and getattr(env, "target", "") != "policy":
        raise UserError("ppo.policy_theta = True trains a teacher; the commands that can are train and play")
    if config.memory_size != getattr(env, "memory_size", 0):
        raise UserError(
            f"ppo.memory = {config.memory}: the environment has to carry the memory on, see rl.recurrent.remembering"
        )
    env = _for_learner(env, config)
    if config.shared_trunk and critic_group(env) != "policy":
        raise UserError(
            f"ppo.shared_trunk = True: {type(env).__name__} shows its critic other observations than its policy, so "
            "they need a network each; set it to False"
        )
    _mirrors(env, config)
    _check_shares(config, mesh)
    _check_memory(env, config, mesh)


@lru_cache(maxsize=32)
def _init(env: Env, config: PPOConfig, mesh: Mesh | None) -> Callable[..., TrainState]:
    sizes = {group: env.observation_size[group][0] for group in {"policy", critic_group(env)}}

    def run(key: jax.Array, domain: Distribution | None, clock: jax.Array) -> TrainState:
        key, network_key, reset_key, clock_key = jax.random.split(key, 4)
        hidden = (config.hidden_actor, config.hidden_critic, config.init_std)
        kind = (config.state_dependent_std, config.shared_trunk)
        memory = (config.memory, config.memory_cell)
        widths = (sizes["policy"], sizes[critic_group(env)], env.action_size - config.memory_size)
        params = networks.init(network_key, *widths, *hidden, *kind, *memory, weight_init=config.weight_init)
        worlds = _reset(env, reset_key, domain, config.num_envs, mesh, clock)
        env_states, partial = _stagger(clock_key, worlds, env.episode_length)
        state = TrainState(
            params=params,
            opt_state=losses.optimiser_init(params),
            normalizer={group: normalise.init(size) for group, size in sizes.items()},
            learning_rate=jnp.float32(config.learning_rate),
            env_states=env_states,
            episodes=episodes.init(partial),
            key=key,
            iteration=jnp.int32(0),
            env_steps=jnp.uint32(0),
            config=config,
            rnd=_new_rnd(env, config, key, partial),
            mesh=mesh,
        )
        return sharding.pinned(strong(state), mesh, layout(state))

    return jax.jit(run)


def _new_rnd(env: Env, config: PPOConfig, key: jax.Array, partial: jax.Array) -> RND | None:
    """The networks of random network distillation, with a key of their own."""
    if config.rnd is None:
        return None
    size = sum(env.observation_size[group][0] for group in rnd.groups(env.observation_size, config.rnd))
    return rnd.init(jax.random.fold_in(key, 1), size, partial, config.rnd)


def _collect(
    env: Env,
    config: PPOConfig,
    state: TrainState,
    domain: Distribution | None,
    key: jax.Array,
    more: Sequence[str] = (),
) -> tuple[State, dict]:
    """num_steps in every world with the current policy; resets come from a pool drawn once per update.

    The observation groups are those that the networks see, and `more`.
    """
    pool_key, noise_key = jax.random.split(key)
    mesh, novel = state.mesh, () if config.rnd is None else rnd.groups(env.observation_size, config.rnd)
    memory = ("memory",) if config.memory else ()
    groups = tuple(sorted({*state.normalizer, *novel, *memory, *more}))

    def run(policy: Policy, noise: jax.Array, env_states: State, pool: State) -> tuple[State, dict]:
        def act(noise: jax.Array, obs: dict[str, jax.Array]) -> tuple[jax.Array, dict]:
            mean, log_std = policy.distribution(obs)
            action = mean + jnp.exp(log_std) * noise
            extras = {"action": action, "mean": mean}
            done = policy.carried(obs, policy.bounded(action))
            return done, extras if log_std.ndim == 1 else extras | {"log_std": log_std}

        return collect(env, act, noise, env_states, pool, groups)

    shape = (config.num_steps, config.num_envs, env.action_size - config.memory_size)
    noise = sharding.pinned(jax.random.normal(noise_key, shape), mesh, SECOND)
    pool = _reset(env, pool_key, domain, config.num_envs, mesh, _clock(env, state.env_states))
    run = sharding.local(run, mesh, (EVERYWHERE, SECOND, FIRST, FIRST), (FIRST, SECOND))
    return run(policy_of(state), noise, state.env_states, pool)


def _statistics(config: PPOConfig, state: TrainState, data: dict) -> dict[str, normalise.Moments]:
    """Those of the observations up to these: learnt with at once, as the policy will act with them.

    A policy that learns with the statistics that it was collected with acts with others than it learnt with, which
    costs most where they are still young (CartpoleBalance of Playground: twice the samples; benchmarks/history.md).
    """
    if not config.normalize_observations:
        return state.normalizer
    return {group: normalise.update(m, data["observation"][group]) for group, m in state.normalizer.items()}


def _batch(
    env: Env, config: PPOConfig, state: TrainState, data: dict, normalizer: dict[str, normalise.Moments]
) -> losses.Batch:
    """The collected [T, N] arrays as B = T N transitions with values, advantages and returns, computed once.

    With a memory as N sequences of T steps instead, with ppo.segment as B / L segments of L steps. Observations are
    normalised by `normalizer`; the actions' probabilities are those of the policy that acted, by the state's. KL counts
    from the policy that learning starts from: new statistics alone would slow an adaptive rate down.
    """
    act, group = networks.activation(config.activation), critic_group(env)

    def seen(which: str, group: str) -> Any:
        x = data[which][group]
        return normalise.normalise(normalizer[group], x) if config.normalize_observations else x

    def valued(which: str) -> Any:
        x = seen(which, group)
        return recurrent.Remembered(x, data[which]["memory"]) if config.memory and config.shared_trunk else x

    observation, critic_observation = seen("observation", "policy"), valued("observation")
    value = networks.value(state.params, critic_observation, act)
    next_value = networks.value(state.params, valued("final_observation"), act)
    if config.memory:
        steps = recurrent.Remembered(observation, data["observation"]["memory"])
        observation = recurrent.sequences(steps, jnp.maximum(data["terminated"], data["truncated"]))
        critic_observation = observation if config.shared_trunk else critic_observation
    reward = config.reward_scale * data["reward"]
    ends = (data["terminated"], data["truncated"])
    advantage, returns = gae(reward, value, next_value, *ends, config.gamma, config.gae_lambda)
    action, mean, log_std = data["extras"]["action"], data["extras"]["mean"], data["extras"].get("log_std")
    fixed = state.params["actor"].get("log_std")
    log_prob = networks.log_prob(mean, fixed if log_std is None else log_std, action)
    if config.normalize_observations:
        turned = partial(jax.tree.map, lambda x: x.swapaxes(0, 1) if config.memory else x)
        mean, spread = networks.gaussian(state.params["actor"], turned(observation), act)
        mean, log_std = turned((mean, None if log_std is None else spread))
    batch = losses.Batch(
        observation=observation,
        critic_observation=critic_observation,
        action=action,
        mean=mean,
        log_prob=log_prob,
        value=value,
        advantage=advantage,
        returns=returns,
        log_std=log_std,
        copies=_copies(env, config, state, data, normalizer, log_prob),
    )
    if config.segment:
        future = segments.Future(reward, *ends, next_value, seen("final_observation", group))
        batch = dataclasses.replace(batch, future=segments.ended(future, config.segment))
    alike = group == "policy" and not config.memory  # actor and critic see the same: it is sent to the devices once
    batch = dataclasses.replace(batch, critic_observation=None) if alike else batch
    batch = sharding.pinned(batch, state.mesh)  # whole on every device: minibatches are drawn from all worlds
    batch = dataclasses.replace(batch, critic_observation=batch.observation) if alike else batch
    if config.segment:
        return segments.cut(batch, config.segment)
    return jax.tree.map(lambda x: x.swapaxes(0, 1) if config.memory else x.reshape(-1, *x.shape[2:]), batch)


def _copies(
    env: Env,
    config: PPOConfig,
    state: TrainState,
    data: dict,
    normalizer: dict[str, normalise.Moments],
    own: jax.Array,
) -> symmetry.Copies | None:
    """Mirror images [T, N, K, ...] of the collected transitions, whose log-probabilities are `own` [T, N].

    None where ppo.symmetry is off.
    """
    maps = _mirrors(env, config)
    if not maps:
        return None
    act, group = networks.activation(config.activation), critic_group(env)

    def seen(group: str, moments: dict[str, normalise.Moments]) -> jax.Array:
        raw = symmetry.images(data["observation"][group], [m.observation[group] for m in maps])
        return normalise.normalise(moments[group], raw) if config.normalize_observations else raw

    observation, critic_observation = seen("policy", normalizer), seen(group, normalizer)
    action = symmetry.images(data["extras"]["action"], [m.action for m in maps])
    collector = networks.gaussian(state.params["actor"], seen("policy", state.normalizer), act)
    log_prob = networks.log_prob(*collector, action)
    value = networks.value(state.params, critic_observation, act)
    weight = jnp.exp(jnp.minimum(0.0, log_prob - own[..., None]))
    return symmetry.Copies(observation, critic_observation, action, log_prob, value, weight)


def _novelty(
    env: Env, config: PPOConfig, state: TrainState, data: dict, key: jax.Array
) -> tuple[RND | None, jax.Array | None, dict[str, jax.Array]]:
    """The predictor trained on what was collected, the reward [T, N] for its novelty before, and the losses."""
    if config.rnd is None or state.rnd is None:
        return None, None, {}
    after = rnd.joined(data["final_observation"], rnd.groups(env.observation_size, config.rnd))
    ends = (data["terminated"], data["truncated"])
    novel, x, bonus = rnd.reward(state.rnd, after, *ends, config.rnd, env.dt, config.gamma)
    x = sharding.pinned(x, state.mesh).reshape(-1, x.shape[-1])
    novel, values = rnd.train(key, novel, x, config.rnd, config.num_epochs, config.num_minibatches, state.mesh)
    return novel, bonus, {"Loss/rnd": values}


def moved_on(config: PPOConfig, state: TrainState, env_states: State, data: dict, key: jax.Array) -> TrainState:
    """The state after a collection: worlds, episodes and counters; what is learnt from it is as before."""
    return dataclasses.replace(
        state,
        env_states=env_states,
        episodes=episodes.update(state.episodes, data["reward"], data["terminated"], data["truncated"]),
        key=key,
        iteration=state.iteration + 1,
        env_steps=state.env_steps + jnp.uint32(config.num_envs * config.num_steps),
    )


def update(
    env: Env, config: PPOConfig, state: TrainState, domain: Distribution | None
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One iteration, to be jitted: the new state and its metrics, scalars under their TensorBoard tags."""
    env = _for_learner(env, config)
    key, collect_key, epochs_key = jax.random.split(state.key, 3)
    env_states, data = _collect(env, config, state, domain, collect_key)
    novel, bonus, novelty_loss = _novelty(env, config, state, data, epochs_key)
    normalizer = _statistics(config, state, data)
    rewarded = data if bonus is None else data | {"reward": data["reward"] + bonus}
    batch = _batch(env, config, state, rewarded, normalizer)
    params, opt_state, rate, figures = losses.optimise(
        epochs_key, state.params, state.opt_state, state.learning_rate, batch, config, _mirrors(env, config), state.mesh
    )
    figures |= novelty_loss
    after = dataclasses.replace(
        moved_on(config, state, env_states, data, key),
        params=params,
        opt_state=opt_state,
        normalizer=normalizer,
        learning_rate=rate,
        rnd=novel,
    )
    metrics = {name: x.mean() for name, x in figures.items()} | {
        "Loss/learning_rate": rate,
        # explained variance = 1 - var(R - V) / var(R)
        "Loss/explained_variance": 1 - (batch.returns - batch.value).var() / (batch.returns.var() + 1e-8),
        "Policy/mean_std": jnp.exp(params["actor"]["log_std"] if batch.log_std is None else batch.log_std).mean(),
        "env_steps": after.env_steps,
        **episodes.metrics(after.episodes),
    }
    if config.rnd is not None and novel is not None:
        metrics |= rnd.metrics(novel, metrics["Train/mean_reward"], config.rnd)
    return sharding.pinned(after, state.mesh, layout(after)), metrics


@lru_cache(maxsize=32)
def make_update(env: Env, config: PPOConfig) -> Update:
    """update(state, domain) -> (state, metrics of scalars), one jitted program; the same one for the same arguments."""
    return jax.jit(lambda state, domain=None: update(env, config, state, domain))
