"""The contract of an effect: something the nominal simulator leaves out; its neutral parameters switch it off."""

import abc
import dataclasses
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.quantity import Quantity
from bayessim_mjx.effects.support.site import Site, find, floating, under_tendon_limit
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace

if TYPE_CHECKING:
    import mujoco
    from mujoco import mjx

__all__ = ["Block", "Effect", "Measurement", "Quantity", "layout", "overrides"]

Measurement = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class Effect(abc.ABC):
    """One unmodelled effect, at one place of the robot or at several.

    Subclasses are frozen dataclasses, state `name`, `kind` and `quantities`, and override the hooks they need; the
    others are the identity and cost nothing. Rules: hooks are pure and traceable; every number that may be inferred is
    an entry of `theta` (this effect's own slice, in the order of `space()`); at the neutral theta each hook returns its
    input bit for bit. Hooks work on all places at once: `at.values(theta)` is `[places, quantities]`. Each takes `at`,
    where the effect sits; most take `memory`, as `init` or the last call left it, and return it first.

    Attributes:
        where: MuJoCo name of the actuator, joint, body ... concerned; a tuple of names: each with values of its own;
            "all": every place of the kind, all with the same values.
        parameters: with other ranges and priors than the effect's own, in the place of those of the same name.
    """

    where: str | tuple[str, ...]
    parameters: tuple[Parameter, ...] = dataclasses.field(default=(), kw_only=True)
    name: ClassVar[str]
    kind: ClassVar[str]  # actuator | joint (hinge or slide) | body | geom | world
    quantities: ClassVar[tuple[Quantity, ...]]
    contains: ClassVar[tuple[str, ...]] = ()  # effects that are special cases of this one
    effort: ClassVar[str] = (
        ""  # of one parameter: acceleration, speed, drag or dry (sign of speed), to which it is a force
    )
    joint: ClassVar[bool] = False  # its amplitudes are searched together: one alone may not act at all
    star: ClassVar[bool] = False  # its shapes are searched one at a time, the others in the middle of their grids
    tied: ClassVar[bool] = True  # whether the same values at all places are a candidate
    # whether its on_model changes masses or inertias: what MuJoCo derives from them is computed after all of these, and
    # only then the other effects change the model
    inertial: ClassVar[bool] = False
    # whether a diagnosis has it act on commands behind the others: a pure delay commutes with each of them, but by part
    # of a sub-step it mixes two commands, which what is not linear has to see one by one
    last: ClassVar[bool] = False
    relative: ClassVar[bool] = False  # its number multiplies one that the model has (kp)
    loop: ClassVar[str] = ""  # number of a controller (kp, kd) that it multiplies; on offer where logs declare one
    # whether its number is a time by which a signal of its joint is late
    late: ClassVar[bool] = False
    floats: ClassVar[bool] = False  # only bodies with a free joint carry it; nothing is said of it where there are none
    offered: ClassVar[bool] = True  # among all the effects that a diagnosis tries; else only where it is named
    # whether it draws at random in every control step: its memory is a dict with a "key", which `Physics.world` sets. A
    # diagnosis does not try it: its simulator is deterministic
    random: ClassVar[bool] = False
    # for people; where these are empty, `support.words` says something by name and docstring
    noun: ClassVar[str] = ""  # what it is called: "command delay"
    lacks: ClassVar[str] = ""  # after "the simulator lacks", where that is not the noun: "a command delay"
    separates: ClassVar[str] = ""  # the experiment that separates it from its look-alikes
    # whether its memory at a start in the middle of a log is found by taking it along the recorded motion before
    follows: ClassVar[bool] = False
    witness: ClassVar[tuple[str, str] | None] = None  # (stream of a log that shows it directly, what to record)

    @classmethod
    def carries(cls, model: "mujoco.MjModel", i: int) -> bool:
        """Whether element `i` of its kind has what the effect changes (a servo's gains); it is on offer only there."""
        return not cls.floats or floating(model, i)

    def places(self) -> tuple[str, ...]:
        """Names that own a set of parameters."""
        return (self.where,) if isinstance(self.where, str) else tuple(self.where)

    def defaults(self) -> ParameterSpace:
        """List the effect's own parameters: kind "effect", nominal = neutral, named `<where>.<effect>.<parameter>`."""
        return ParameterSpace(self._parameter(place, q) for place in self.places() for q in self.quantities)

    def _parameter(self, place: str, q: Quantity) -> Parameter:
        label = f"{place}.{self.name}.{q.name}"
        only = not q.optional and sum(not other.optional for other in self.quantities) == 1
        high = getattr(self, "high", q.high) if only else q.high
        return Parameter(
            label, q.neutral, q.low, high, unit=q.unit, prior=q.prior, attribute=q.name, target=place, kind="effect"
        )

    def space(self) -> ParameterSpace:
        """Return the effect's parameters in the order of `defaults`, with the ranges and priors that hold here."""
        other = {p.name: p for p in self.parameters}
        return ParameterSpace(other.get(p.name, p) for p in self.defaults().parameters)

    def with_all(self) -> Self:
        """Return the effect with its optional numbers."""
        every = (self._parameter(place, q) for place in self.places() for q in type(self).quantities)
        given = {p.name for p in self.parameters}
        return dataclasses.replace(self, parameters=(*self.parameters, *(p for p in every if p.name not in given)))

    def blocks(self, start: int = 0) -> "tuple[Block, ...]":
        """Its numbers by place, the first of them at `start` of theta."""
        k, parameters = len(self.quantities), self.space().parameters
        return tuple(Block(self, p, start + i * k, parameters[i * k :][:k]) for i, p in enumerate(self.places()))

    def check(self) -> None:
        """Refuse ranges that reach where the physics has no meaning: beyond the end of a quantity that ends at neutral.

        Raises:
            UserError: naming the parameter, its range and the end.
        """
        for p, q in ((p, q) for block in self.blocks() for p, q in block.pairs()):
            if q.neutral == q.low and p.low < q.low:
                raise UserError(f"{p.name}: range begins at {p.low:g} {p.unit}; allowed: from {q.low:g} (off) upwards")
            if q.neutral == q.high and p.high > q.high:
                raise UserError(f"{p.name}: range ends at {p.high:g} {p.unit}; allowed: up to {q.high:g} (off)")

    def __post_init__(self) -> None:
        named = {p.attribute for p in self.parameters}
        own = tuple(q for q in type(self).quantities if q.name in named or not q.optional)
        object.__setattr__(self, "quantities", own)
        high = getattr(self, "high", None)
        if high is not None and not 0 < high < math.inf:
            raise UserError(f"{self.name}: high = {high} {self.quantities[0].unit}, must be positive and finite")
        if not self.places():
            raise UserError(f"{self.name}: where = (): give at least one {self.kind}")
        self.check()

    def bind(self, mj_model: "mujoco.MjModel", timestep: float, substeps: int) -> Site:
        """Where the effect sits in this model; the hooks' argument `at`. Static: no traced values.

        Raises:
            UserError: naming the effect, the unknown place and what may be meant.
        """
        at = find(self, mj_model, timestep, substeps)
        limited = under_tendon_limit(mj_model)[at.ids] if self.kind == "actuator" else np.zeros(0, bool)
        if limited.any() and overrides(self, "on_actuator"):
            name = at.names[int(np.argmax(limited))]
            raise UserError(
                f"{self.name}: actuator {name!r} drives a tendon with an actuatorfrcrange, which MJX takes before "
                "effects act; allowed: other actuators, or forcerange at the actuator in its place"
            )
        return at

    def init(self, at: Site) -> Any:
        """Memory at the start of an episode: a pytree of arrays of fixed shape; constants belong in the site."""
        return ()

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        """Change the model; called once per episode. Leave untouched leaves the identical objects.

        What MuJoCo derives from the leaves (`dof_M0`, `body_invweight0`, ...) is renewed behind effects that are
        `inertial`; others that change what it comes from do so themselves (`parameters.set_const`).
        """
        return model

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        """Find the true motion around a start state behind the measured one (the inverse of `on_measurement`).

        Only called where an episode starts in the middle of a log: also fill the memory from `motion` here.
        """
        return memory, motion

    def on_record(
        self, at: Site, memory: Any, before: "Measurement", after: "Measurement", theta: jax.Array
    ) -> "tuple[Any, Measurement]":
        """Change the recorded state `after` that replaces the simulated one, `before`, at the same time.

        Only called along the recorded past of what `follows` the motion.
        """
        return memory, after

    def on_motors(
        self, at: Site, memory: Any, ahead: "Measurement", state: "Measurement", theta: jax.Array
    ) -> "tuple[Any, Measurement]":
        """Change at a start how far and how fast motors are ahead of their links: more, by `ahead`, `[nv]` each.

        What the encoders show stays: where they sit on the motors, the links move. A diagnosis finds `ahead`.
        """
        return memory, state

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        """Change the command of one control step, `[substeps, nu]`: one row per sub-step (four of them by RK4)."""
        return memory, command

    def on_law(self, at: Site, law: Any, theta: jax.Array) -> Any:
        """Change the controller between command and actuators (`physics.controllers.Law`), where one is declared."""
        return law

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        """Change the actuators' forces `[nu]` of this sub-step, as MuJoCo and earlier effects left them.

        Called once in every stage of the integrator, always with the memory of before the sub-step; kept is what the
        first stage returns. An implicit integrator takes its derivative in `force` too (how much of a servo's damping
        arrives), by `jax.jvp`. The joint's limit (`actuatorfrcrange`) comes later.
        """
        return memory, force

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        """Generalised force `[nv]` to add in this sub-step; `step.force` is the sum of all other known forces.

        It includes the newest forces of the other effects (of this sub-step or the last); of constraints only
        equalities, see `SubStep`.
        """
        return memory, jnp.zeros_like(step.force)

    def transmits(self, at: Site, theta: jax.Array) -> jax.Array:
        """`[nv]` bool: at which degrees of freedom `on_force` replaces the actuators' torque by what it passes on.

        That is of the whole sub-step, so this torque does not change between the stages of an integrator either.
        """
        return jnp.zeros(at.nv, bool)

    def rates(self, at: Site, memory: Any) -> dict[str, jax.Array]:
        """Rates of those entries of the memory that an integrator of several stages (RK4) moves, as `on_force` left it.

        An effect that has this hook exerts the force of each stage, in place of one that is held over the sub-step:
        `on_force` is called in every stage with the memory moved so far, and itself moves none of these entries. None
        of them ({}): the force depends on the state alone. Other integrators do not call it.
        """
        return {}

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        """Change what the sensors show after a reset or a control step: `{"qpos": [nq], "qvel": [nv]}`.

        From the memory that `init` gives it shows what a robot at rest there would have shown for ever.
        """
        return memory, measurement

    def echoes(self, at: Site, theta: jax.Array) -> jax.Array:
        """`[nv]`, control steps after a start in a log for which what is shown is older than the start.

        It can only be read from the recording then, and agrees with it whatever the simulator does.
        """
        return jnp.zeros(at.nv)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        """Write the effect into `spec` where MuJoCo can express it natively; `values[place][quantity]`.

        Returns:
            None where written, else why not (one sentence for people); a `Part` where a part of it is written.
        """
        return "MuJoCo has no such element"


class Part(str):
    """What of an effect `Effect.edit` could not write, where it wrote the rest."""


def overrides(effect: Effect, hook: str) -> bool:
    """Whether the effect has this hook; those it does not have are not called."""
    return getattr(type(effect), hook) is not getattr(Effect, hook)


@dataclasses.dataclass(frozen=True)
class Block:
    """Numbers that stand together in theta: the model's parameters, or those of one effect at one place.

    Attributes:
        effect: None: the model.
        place: as the effect's `where` calls it; "" of the model.
        start: of the first one in theta.
        parameters: in the order of theta; of an effect in that of its quantities.
    """

    effect: Effect | None
    place: str
    start: int
    parameters: tuple[Parameter, ...]

    @property
    def stop(self) -> int:
        return self.start + len(self.parameters)

    @property
    def slice(self) -> slice:
        """Of theta."""
        return slice(self.start, self.stop)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        return () if self.effect is None else self.effect.quantities

    @property
    def neutral(self) -> tuple[float, ...]:
        """The values that switch the effect off; of the model the nominal ones."""
        return tuple(q.neutral for q in self.quantities) if self.effect else tuple(p.nominal for p in self.parameters)

    def pairs(self) -> Iterable[tuple[Parameter, Quantity]]:
        """Each parameter with what the effect says of it."""
        return zip(self.parameters, self.quantities, strict=True)


Ordered = TypeVar("Ordered", Effect, type[Effect])


def in_order(effects: Iterable[Ordered]) -> list[Ordered]:
    """Effects, or their classes, in the order in which a diagnosis has them act: those that are `last` at the end."""
    return sorted(effects, key=lambda effect: effect.last)


def layout(space: ParameterSpace, effects: Iterable[Effect]) -> tuple[Block, ...]:
    """theta: the model's parameters, then those of each effect at each of its places."""
    out = [Block(None, "", 0, space.parameters)]
    for effect in effects:
        out += effect.blocks(out[-1].stop)
    return tuple(out)
