"""The contract of an effect: something the nominal simulator leaves out; its neutral parameters switch it off."""

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.parameters import ParameterSpace

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
    """

    where: str
    name: ClassVar[str]

    @abc.abstractmethod
    def space(self) -> ParameterSpace:
        """The effect's parameters: kind "effect", nominal = neutral, named `<where>.<effect>.<parameter>`."""

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
        ValueError: naming the effect, the unknown name and the names there are.
    """
    if name not in names:
        raise ValueError(f"{effect}: no {kind} {name!r} in the model; there are: {', '.join(names)}")
    return names.index(name)
