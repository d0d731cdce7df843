"""What episodes draw at random beside their parameters, and nobody infers: noise on observations and actions, gravity.

BayesSimIG's `observations`, `actions`, `sim_params.gravity` and `frequency` in `task.randomization_params`, with Isaac
Gym's meaning of their numbers. A noise has a white part, drawn at every step (`range`), and one that lasts as long as
the parameters do (`range_correlated`): a bias.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.config.foreign import SIM_PARAMS
from bayessim_mjx.errors import UserError
from bayessim_mjx.keys import branch
from bayessim_mjx.parameters import ParameterSpace, checks
from bayessim_mjx.parameters.parameter import OVER, Schedule
from bayessim_mjx.parameters.reading import PATH

DISTRIBUTIONS = ("gaussian", "uniform", "loguniform")
OPERATIONS = ("additive", "scaling")
KEYS = ("range", "range_correlated", "operation", "distribution", "schedule", "schedule_steps")
GRAVITY = "opt.gravity"  # leaf of the model
FOREVER = OVER  # `frequency` of parameters that are drawn once


class Course(struct.PyTreeNode):
    """What a world carries on from episode to episode.

    Attributes:
        source: `[2]`, the key that gravity and lasting noise are drawn with, kept as long as the parameters are.
        clock: `[]` int32, control steps since training began, which schedules go by.
        age: `[]` int32, control steps since parameters, gravity and lasting noise were drawn.
    """

    source: jax.Array
    clock: jax.Array
    age: jax.Array


class Drawn(struct.PyTreeNode):
    """What is drawn in one world.

    Attributes:
        course: across episodes.
        key: `[2]`, of the next steps' white noise.
        observation: `[S]`, action: `[A]`, the lasting parts; `[0]` where there are none.
    """

    course: Course
    key: jax.Array
    observation: jax.Array
    action: jax.Array


@dataclasses.dataclass(frozen=True)
class Spread:
    """A distribution of one number: gaussian with mean and standard deviation, or between two ends."""

    distribution: str
    first: float
    second: float

    def draw(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        if self.distribution == "gaussian":
            return self.first + self.second * jax.random.normal(key, shape)
        if self.distribution == "uniform":
            return self.first + (self.second - self.first) * jax.random.uniform(key, shape)
        low, high = jnp.log(jnp.float32(self.first)), jnp.log(jnp.float32(self.second))
        return jnp.exp(low + (high - low) * jax.random.uniform(key, shape))


@dataclasses.dataclass(frozen=True)
class Noise:
    """A number that is added, or that multiplies; weakened towards nothing by its schedule."""

    white: Spread
    lasting: Spread | None
    operation: str
    schedule: Schedule

    def bias(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Return a draw of the lasting part; `[0]` where there is none."""
        return jnp.zeros((0,)) if self.lasting is None else self.lasting.draw(key, shape)

    def apply(self, key: jax.Array, x: jax.Array, bias: jax.Array, clock: jax.Array) -> jax.Array:
        """`x` with noise, of x's shape."""
        strength, drawn = self.schedule.strength(clock), self.white.draw(key, x.shape)
        drawn = drawn if self.lasting is None else drawn + bias
        # x + s d, or x (1 + s (d - 1))
        return x + strength * drawn if self.operation == "additive" else x * (1.0 + strength * (drawn - 1.0))


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """All of it, static; `begin` and the others are pure functions on one world's `Drawn`."""

    observations: Noise | None = None
    actions: Noise | None = None
    gravity: Noise | None = None
    frequency: int = 1

    @property
    def fields(self) -> tuple[str, ...]:
        """Arrays of the model that do not follow from the parameters alone."""
        return (GRAVITY,) if self.gravity is not None else ()

    def begin(self, key: jax.Array, course: Course | None, actions: int) -> Drawn:
        """At a reset: new draws where these are due (`course` None: they are, and all schedules are over)."""
        source, key = jax.random.split(key)
        if course is None:
            course = Course(source, jnp.int32(OVER), jnp.int32(0))
        else:
            due = course.age >= self.frequency
            new = jnp.where(due, source, course.source), jnp.where(due, 0, course.age).astype(jnp.int32)
            course = course.replace(source=new[0], age=new[1])
        none = jnp.zeros((0,))
        action = none if self.actions is None else self.actions.bias(self._key(course, 1), (actions,))
        return Drawn(course, key, none, action)

    def seen(self, drawn: Drawn, size: int) -> Drawn:
        """With the lasting part of the noise on `size` observations."""
        if self.observations is None:
            return drawn
        return drawn.replace(observation=self.observations.bias(self._key(drawn.course, 0), (size,)))

    def _key(self, course: Course, purpose: int) -> jax.Array:
        return branch(course.source, purpose)

    def gravity_of(self, drawn: Drawn, gravity: jax.Array) -> jax.Array:
        """Gravity `[3]` of this episode; Isaac Gym draws each axis by itself."""
        assert self.gravity is not None
        return self.gravity.apply(self._key(drawn.course, 2), gravity, jnp.zeros((0,)), drawn.course.clock)

    def act(self, drawn: Drawn, action: jax.Array) -> tuple[Drawn, jax.Array]:
        """(drawn, noisy action) of one step."""
        if self.actions is None:
            return drawn, action
        key, own = jax.random.split(drawn.key)
        return drawn.replace(key=key), self.actions.apply(own, action, drawn.action, drawn.course.clock)

    def observe(self, drawn: Drawn, observation: jax.Array) -> tuple[Drawn, jax.Array]:
        """(drawn, noisy observation)."""
        if self.observations is None:
            return drawn, observation
        key, own = jax.random.split(drawn.key)
        noisy = self.observations.apply(own, observation, drawn.observation, drawn.course.clock)
        return drawn.replace(key=key), noisy

    def after_step(self, drawn: Drawn) -> Drawn:
        """Move the counters one control step on; they stop before they overflow."""
        course = drawn.course
        later = {name: jnp.minimum(getattr(course, name) + 1, OVER) for name in ("clock", "age")}
        return drawn.replace(course=course.replace(**later))


def starting(clock: Any, worlds: int) -> Course:
    """Of `worlds` worlds that draw anew at their next reset, `clock` control steps into training."""
    fill = lambda value: jnp.full((worlds,), value, jnp.int32)  # noqa: E731
    return Course(jnp.zeros((worlds, 2), jnp.uint32), fill(clock), fill(OVER))


def read(section: Mapping[str, Any], space: ParameterSpace) -> Nuisance | None:
    """Return the nuisances of `randomization_params`; None without any, and without a schedule in `space`.

    Raises:
        UserError: naming the key's path, its value and what is allowed.
    """
    section = checks.mapping(section, PATH)
    section = checks.mapping(section.get("randomization_params", section), PATH)
    physical = checks.mapping(section.get("sim_params"), f"{PATH}.sim_params")
    checks.known(physical, ("gravity", *SIM_PARAMS), f"{PATH}.sim_params")
    frequency = checks.number(section.get("frequency") or 1, f"{PATH}.frequency")
    if not (1 <= frequency <= FOREVER and frequency == int(frequency)):
        raise UserError(
            f"{PATH}.frequency = {section['frequency']!r}: expected a whole number of control steps from 1 to {FOREVER}"
        )
    found = Nuisance(
        observations=_noise(section.get("observations"), f"{PATH}.observations"),
        actions=_noise(section.get("actions"), f"{PATH}.actions"),
        gravity=_noise(physical.get("gravity"), f"{PATH}.sim_params.gravity", lasts=False),
        frequency=int(frequency),
    )
    scheduled = any(p.schedule.steps for p in space.parameters)
    return found if scheduled or found != Nuisance() else None


def _noise(setting: Any, where: str, lasts: bool = True) -> Noise | None:
    setting = checks.mapping(setting, where)
    if not setting:
        return None
    checks.known(setting, KEYS if lasts else tuple(k for k in KEYS if k != "range_correlated"), where)
    kind = checks.choice(setting, "distribution", DISTRIBUTIONS, "gaussian", where)
    lasting = setting.get("range_correlated") if lasts else None
    return Noise(
        white=_spread(kind, setting.get("range"), f"{where}.range"),
        lasting=None if lasting is None else _spread(kind, lasting, f"{where}.range_correlated"),
        operation=checks.choice(setting, "operation", OPERATIONS, "additive", where),
        schedule=Schedule.read(setting, where),
    )


def _spread(kind: str, value: Any, where: str) -> Spread:
    if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != 2:
        what = "[mean, standard deviation]" if kind == "gaussian" else "[low, high]"
        raise UserError(f"{where} = {value!r}: a {kind} distribution takes {what}")
    first, second = (checks.number(v, where) for v in value)
    if kind == "gaussian" and second < 0:
        raise UserError(f"{where} = {list(value)}: the standard deviation is negative")
    if kind != "gaussian" and first > second:
        raise UserError(f"{where} = {list(value)}: low must not be more than high")
    if kind == "loguniform" and first <= 0:
        raise UserError(f"{where} = {list(value)}: loguniform needs low > 0")
    return Spread(kind, first, second)
