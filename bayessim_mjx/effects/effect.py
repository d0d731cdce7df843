"""The contract of an effect: something the nominal simulator leaves out; its neutral parameters switch it off."""

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.parameters.attributes import suggest

if TYPE_CHECKING:
    from mujoco import mjx

    from bayessim_mjx.physics import Physics

Measurement = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class Effect(abc.ABC):
    """One unmodelled effect at one place of the robot.

    Subclasses are frozen dataclasses and override the hooks they need; the others are the identity and cost nothing.
    Rules: hooks are pure and traceable; every number that may be inferred is an entry of `theta` (this effect's own
    slice, in the order of `space()`); at the nominal (= neutral) theta each hook returns its input bit for bit.

    Attributes:
        where: MuJoCo name of the joint, actuator, body ... concerned, or "all" where the effect allows it.
        parameters: with other ranges and priors than the effect's own, in the place of those of the same name.
    """

    where: str
    parameters: tuple[Parameter, ...] = dataclasses.field(default=(), kw_only=True)
    name: ClassVar[str]

    @abc.abstractmethod
    def defaults(self) -> ParameterSpace:
        """The effect's own parameters: kind "effect", nominal = neutral, named `<where>.<effect>.<parameter>`."""

    def space(self) -> ParameterSpace:
        """The effect's parameters in the order of `defaults`, with the ranges and priors that hold here."""
        other = {p.name: p for p in self.parameters}
        return ParameterSpace(other.get(p.name, p) for p in self.defaults().parameters)

    def init(self, physics: "Physics") -> Any:
        """Memory at the start of an episode, a pytree of arrays. Refuse an unknown `where` here (ValueError)."""
        return ()

    def on_model(self, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        """Change the model; called once per episode. Leave untouched leaves the identical objects."""
        return model

    def on_command(self, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        """Change the command of one control step, `[substeps, nu]`: one row per sub-step, all equal without effects."""
        return memory, command

    def on_force(self, memory: Any, model: "mjx.Model", data: "mjx.Data", theta: jax.Array) -> tuple[Any, jax.Array]:
        """Generalised force `[nv]` to add in this sub-step.

        `data` holds this sub-step's mass matrix, qfrc_bias, qfrc_passive and qfrc_actuator, and in qfrc_applied the sum
        of the newest forces of all other effects (of this sub-step or the last). Constraint forces are not known yet.
        """
        return memory, jnp.zeros_like(data.qfrc_applied)

    def on_measurement(self, memory: Any, measurement: Measurement, theta: jax.Array) -> tuple[Any, Measurement]:
        """Change what the sensors show after a control step: `{"qpos": [nq], "qvel": [nv]}`."""
        return memory, measurement


def index_of(kind: str, name: str, names: list[str], effect: str) -> int:
    """Index of `name` among `names`.

    Raises:
        UserError: naming the effect, the unknown name and what may be meant.
    """
    if name not in names:
        raise UserError(f"{effect}: no {kind} {name!r} in the model; {suggest(name, names)}")
    return names.index(name)
