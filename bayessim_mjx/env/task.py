"""Task: the base of the MuJoCo tasks in tasks/."""

import abc
import difflib
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.config.loading import OfFile
from bayessim_mjx.config.settings import IMPLEMENTATIONS, implementation
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.effects.support.reading import stack
from bayessim_mjx.effects.support.storage import corrected
from bayessim_mjx.env import answers
from bayessim_mjx.env.finite import counted, finite
from bayessim_mjx.env.protocol import Env, Observations, State
from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import Mirror, resolve
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.parameters.checks import with_zeros
from bayessim_mjx.parameters.reading import read
from bayessim_mjx.physics import Physics, World, control_step, mjx
from bayessim_mjx.physics.implementation import Choice, choose
from bayessim_mjx.physics.nuisance import GRAVITY, Course, Drawn
from bayessim_mjx.physics.nuisance import read as read_nuisance
from bayessim_mjx.physics.warp import OVERFLOW, overflowed

VARIANTS = ("isaacgymenvs", "bayessim2021")


class Task(Env):
    """Base of the MuJoCo tasks. A subclass gives the model and `initial`, `command`, `observe`, `reward`.

    Args:
        config: settings of `env:` (a mapping, or `config.EnvConfig`): `episodeLength`, `variant` and the task's own
            keys, which are listed with their defaults in `options`.
        randomization: the BayesSimIG `task:` section (key `randomization_params`); None or empty: that of the task's
            file in cfg/, if it has one. `randomize: False` means the model's own physics: no parameters, and no effects
            from the section.
        effects: unmodelled effects to simulate, whose ranges the section's `effects` may change; effects that only the
            section names come after them. theta holds the model's parameters, then those of the effects.
        calibrated: parameters of the model as identified by a diagnosis; see `effects.support.storage.corrected`.

    A world that is no longer finite, or where a velocity reaches `speed_limit`, counts as diverged: it stays in its
    last sound state, and the episode terminates with the reward `diverged_reward`. The learner always gets finite
    numbers: what else a method returns that is none counts as 0, and the metrics `not_finite_<part>` tell where.

    Raises:
        UserError: on an unknown setting or variant; ValueError: on bad parameters or effects.
    """

    control_dt: ClassVar[float]
    default_episode_length: ClassVar[int]
    options: ClassVar[dict[str, Any]] = {}
    randomization: ClassVar[Any] = OfFile("task")
    real_parameters: ClassVar[Any] = OfFile("env", "realParams", "means", 0)
    observation_names: ClassVar[tuple[str, ...]]
    zeros: ClassVar[dict[str, float]] = {}  # see `parameters.zeros`
    mirror: ClassVar[tuple[Mirror, ...]] = ()  # symmetries of the robot by name; resolved in `mirrors`
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": None, "bayessim2021": 100.0}
    max_qvel: ClassVar[float | Sequence[float] | None] = None  # `[nv]`, or one for all
    diverged_reward: ClassVar[float] = 0.0  # of the step in which a world diverges
    speed_limit: ClassVar[float] = 1e5  # |qvel|, m/s or rad/s, from which on a world counts as diverged

    def __init__(
        self,
        config: Mapping[str, Any] | Any = None,
        randomization: Mapping[str, Any] | None = None,
        effects: Sequence[Effect] = (),
        calibrated: Sequence[Parameter] = (),
    ) -> None:
        self.name = type(self).__name__
        self.settings = self._read(config if config is not None else {})
        self.variant: str = self.settings["variant"]
        self.episode_length = int(self.settings["episodeLength"])
        randomization = randomization or {}
        if "randomization_params" not in randomization:  # --randomize says only that there is some
            randomization = {**getattr(self, "randomization", {}), **randomization}
        given = with_zeros(randomization.get("randomization_params") or {}, self.zeros)
        off = randomization.get("randomize") is False
        section = {} if off else given
        spec, mj_model, space = corrected(self.spec(), section, calibrated)
        if off:  # a slip is refused now, not when it is switched on
            read(given, mj_model)
        if calibrated:
            self.spec = spec.copy  # type: ignore[method-assign]  # of the corrected model
        impl, worlds = self.settings["impl"], (config or {}).get("numEnvs")
        every = stack(section, effects)
        self.chosen: Choice | None = choose(self.name, worlds, every) if impl == "auto" else None
        impl = impl if self.chosen is None else self.chosen.impl
        self.physics = Physics(mj_model, self.control_dt, space, every, self.max_qvel, impl, self.settings["unroll"])
        self.joint_names = _names(mj_model, mujoco.mjtObj.mjOBJ_JOINT, mj_model.njnt)
        self.actuator_names = _names(mj_model, mujoco.mjtObj.mjOBJ_ACTUATOR, mj_model.nu)
        self.nuisance = read_nuisance(section, self.physics.space)
        names = {"policy": self.observation_names}
        self.mirrors = tuple(resolve(mirror, mj_model, names) for mirror in self.mirror)

    def _read(self, config: Any) -> dict[str, Any]:
        known = {
            "episodeLength": self.default_episode_length,
            "variant": VARIANTS[0],
            "impl": IMPLEMENTATIONS[0],
            "unroll": False,
            **self.options,
        }
        ignored = {"numEnvs", "realParams", "options"}
        values = {key: config[key] for key in config if key not in ignored and config[key] is not None}
        for key in values:
            if key not in known:
                close = difflib.get_close_matches(key, known)
                hint = f"; did you mean {close[0]}?" if close else ""
                raise UserError(f"env.{key}: {self.name} has no such setting{hint} (it has: {', '.join(known)})")
        settings = {**known, **values}
        implementation(settings["impl"])
        if settings["variant"] not in VARIANTS:
            raise UserError(f"env.variant = {settings['variant']!r}: allowed are {', '.join(VARIANTS)}")
        return settings

    # What a task gives.

    @abc.abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """Make a fresh specification of the nominal model."""

    @abc.abstractmethod
    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Random (qpos `[nq]`, qvel `[nv]`) at the start of an episode."""

    def command(self, action: jax.Array) -> jax.Array:
        """Actuator commands `[nu]` in physical units for an action in [-1, 1]."""
        raise NotImplementedError(f"{self.name} gives its commands in `actuate`")

    @abc.abstractmethod
    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        """Observation groups ("policy", optionally "critic", unclipped) from `world.measurement`.

        After a step `data` is that of the last sub-step (its forces are those of the step, its poses one timestep old);
        at reset it holds the kinematics and no forces, and `action` is zero.
        """

    @abc.abstractmethod
    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        """(reward, terminated (bool), metrics) of one step, from the true states."""

    def actuate(self, world: World, action: jax.Array) -> tuple[World, jax.Array]:
        """(world, actuator commands `[nu]`); instead of `command` where commands have a memory, in `world.task`."""
        return world, self.command(action)

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        """Numbers the task carries along in `world.task` (commands, goals, a key), drawn at reset."""
        return {}

    def advance(self, before: World, world: World, data: mjx.Data, action: jax.Array) -> World:
        """Update `world.task` after the physics and before observation and reward."""
        return world

    # The protocol.

    def reset(self, key: jax.Array, theta: jax.Array | None = None, course: Course | None = None) -> State:
        """`course`: what the world carries on; None: everything is drawn anew, and schedules are over."""
        drawn = None
        if self.nuisance is not None:
            key, key_drawn = jax.random.split(key)
            drawn = self.nuisance.begin(key_drawn, course, self.action_size)
        key, key_start = jax.random.split(key)
        qpos, qvel = answers.begun(self.name, self.initial(key), self.mj_model.nq, self.mj_model.nv)
        return self._begin(key_start, qpos, qvel, theta, drawn)

    def reset_to(self, qpos: jax.Array, qvel: jax.Array, theta: jax.Array | None = None) -> State:
        """Start in a given state (replay from a log); what the task draws at random is drawn with a fixed key."""
        drawn = None
        if self.nuisance is not None:
            drawn = self.nuisance.begin(jax.random.PRNGKey(0), None, self.action_size)
        return self._begin(jax.random.PRNGKey(0), qpos, qvel, theta, drawn)

    def _begin(
        self,
        key: jax.Array,
        qpos: jax.Array,
        qvel: jax.Array,
        theta: jax.Array | None,
        drawn: Drawn | None,
    ) -> State:
        theta = jnp.asarray(self.space.nominal) if theta is None else theta
        world = self._under_gravity(self.physics.world(theta, qpos, qvel, key), drawn)
        world = world.replace(task={"steps": jnp.zeros((), jnp.int32)} | self.start(key, world))
        data, action = self.physics.kinematics(world), jnp.zeros(self.action_size)
        drawn, obs, told = self._observe(world, data, action, drawn)
        zero, named = jnp.zeros(()), jax.eval_shape(lambda: self._rewarded(world, world, data, action)[2])
        metrics = {name: zero for name in (*named, *self._overflow(data))}
        metrics |= counted(True, told, zero, dict.fromkeys(named, zero))
        return State(
            pipeline_state=world,
            obs=obs,
            reward=zero,
            done=zero,
            metrics=metrics,
            info={"terminated": zero, "truncated": zero, "final_observation": obs, "steps": world.task["steps"]}
            | ({} if drawn is None else {"nuisance": drawn}),
        )

    def _under_gravity(self, world: World, drawn: Drawn | None) -> World:
        if self.nuisance is None or self.nuisance.gravity is None or drawn is None:
            return world
        own = world.fields.get(GRAVITY, self.physics.model.opt.gravity)
        return world.replace(fields={**world.fields, GRAVITY: self.nuisance.gravity_of(drawn, own)})

    def step(self, state: State, action: jax.Array) -> State:
        before: World = state.pipeline_state
        action, drawn = jnp.asarray(action, jnp.float32), None
        if self.nuisance is not None:
            drawn, action = self.nuisance.act(state.info["nuisance"], action)
            drawn = self.nuisance.after_step(drawn)
        action = jnp.clip(action, -1.0, 1.0)
        before, command = self.actuate(before, action)
        command = answers.commanded(self.name, command, self.action_size)
        after, data = control_step(self.physics, before, command)
        lost = self._overflow(data)
        after, sound = _hold_if_diverged(before, after, self.speed_limit)
        steps = before.task["steps"] + 1
        after = after.replace(task=after.task | {"steps": steps})
        after = self.advance(before, after, data, action)
        reward, terminated, metrics = self._rewarded(before, after, data, action)
        drawn, obs, told = self._observe(after, data, action, drawn)
        lost |= counted(sound, told, reward, metrics)
        done = (terminated | ~sound).astype(jnp.float32)
        info = state.info | {
            "terminated": done,
            "truncated": (steps >= self.episode_length).astype(jnp.float32),
            "final_observation": obs,
        }
        if drawn is not None:
            info["nuisance"] = drawn
        if "truncation" not in info:  # Brax's EpisodeWrapper counts in info["steps"] itself
            info["steps"] = steps
        return State(
            pipeline_state=after,
            obs=obs,
            reward=finite(jnp.where(sound, reward, self.diverged_reward)),
            done=done,
            # Brax adds its own
            metrics=state.metrics | {name: finite(value) for name, value in metrics.items()} | lost,
            info=info,
        )

    def _rewarded(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        return answers.rewarded(self.name, self.reward(before, after, data, action))

    def _overflow(self, data: mjx.Data) -> dict[str, jax.Array]:
        """Count what the physics could not simulate of a control step, as metrics."""
        return {} if self.physics.warp is None else {OVERFLOW: overflowed(data)}

    def _observe(
        self, world: World, data: mjx.Data, action: jax.Array, drawn: Drawn | None
    ) -> tuple[Drawn | None, Observations, Observations]:
        """Return (what was drawn, what is seen, what `observe` returned)."""
        limit = self.observation_clip[self.variant]
        told = answers.observed(self.name, self.observe(world, data, action))
        obs = {name: finite(value) for name, value in told.items()}
        if (names := len(self.observation_names)) != (numbers := obs["policy"].size):
            counts = f"{names} observation_names for an observation of {numbers} numbers"
            raise UserError(f"{self.name} has {counts}: name each number once")
        if self.nuisance is not None and drawn is not None:  # a critic of its own sees the truth
            if not drawn.observation.size:
                drawn = self.nuisance.seen(drawn, obs["policy"].shape[0])
            drawn, obs["policy"] = self.nuisance.observe(drawn, obs["policy"])
        if limit is not None:
            obs = {name: jnp.clip(value, -limit, limit) for name, value in obs.items()}
        aliases = {"state": "policy", "privileged_state": "critic"}
        return drawn, obs | {alias: obs[group] for alias, group in aliases.items() if group in obs}, told

    # Facts.

    @property
    def space(self) -> ParameterSpace:
        return self.physics.space

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self.physics.mj_model

    @property
    def dt(self) -> float:
        return self.physics.dt

    @property
    def action_size(self) -> int:
        return self.mj_model.nu

    @property
    def sys(self) -> mjx.Model:
        """The nominal model, under Brax's name."""
        return self.physics.model


def _hold_if_diverged(before: World, after: World, speed_limit: float) -> tuple[World, jax.Array]:
    """(world, sound): a world that is no longer finite, or faster than the limit, stays in its last sound state."""
    parts = (after.qpos, after.qvel, after.act)
    sound = functools.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in parts])
    sound &= jnp.all(jnp.abs(after.qvel) < speed_limit)
    keep = ("qpos", "qvel", "act", "warmstart", "time", "memory", "forces", "measurement")
    held = {
        name: jax.tree.map(lambda new, old: jnp.where(sound, new, old), getattr(after, name), getattr(before, name))
        for name in keep
    }
    return after.replace(**held), sound


def _names(mj_model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> tuple[str, ...]:
    return tuple(mujoco.mj_id2name(mj_model, kind, i) or f"{i}" for i in range(count))
