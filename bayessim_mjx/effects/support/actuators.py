"""Actuators of a spec by place, and what follows a command, shared by the effects on actuators."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.support.site import Site

GAINS = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)  # linear in their parameters
BIASES = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
# (state, command) of one sub-step -> (state at its end, mean of the state over it); all [n]
Advance = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


def addressed(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> list[tuple[Any, dict[str, float]]]:
    """(actuator, its values) for the actuators that `values` names; "all": every one."""
    named = [(a.name or f"actuator{i}", a) for i, a in enumerate(spec.actuators)]
    return [(a, values[key]) for name, a in named for key in (name, "all") if key in values]


def nonlinear(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
    """Why an actuator's force cannot be scaled or shifted by its parameters, if so."""
    for actuator, _ in addressed(spec, values):
        if actuator.gaintype not in GAINS or actuator.biastype not in BIASES:
            return f"actuator {actuator.name} is a muscle or a motor model, whose force has no parameter for it"
    return None


def servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's force is linear in its own length: a position servo, or a general affine one like it."""
    linear = model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
    fixed = model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
    return bool(
        linear and fixed and model.actuator_biasprm[actuator, 1] != 0 and model.actuator_gainprm[actuator, 0] != 0
    )


def with_bias(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> list[tuple[Any, dict[str, float]]]:
    """Return `addressed`, the actuators' biasprm with the damping in place that a dampratio stands for."""
    compiled, order, found = spec.copy().compile(), list(spec.actuators), addressed(spec, values)
    for actuator, _ in found:
        actuator.biasprm = compiled.actuator_biasprm[order.index(actuator)]
    return found


class OfGains:
    """What effects on an actuator's gains share: `factor` multiplies `columns` {field of the model: column}."""

    columns: ClassVar[dict[str, int]]

    @classmethod
    def modelled(cls, model: mujoco.MjModel, ids: Sequence[int]) -> dict[str, float]:
        """Return {"factor": the gain that the model has at these actuators, in MJCF's unit}; {} where they differ."""
        (field, k), *_ = cls.columns.items()
        return _alike(getattr(model, field)[list(ids), k])

    @classmethod
    def scaled(cls, model: mujoco.MjModel, i: int, factor: float) -> mujoco.MjModel:
        """Return a copy of a model in which actuator i has another gain."""
        out = copy.copy(model)
        for field, k in cls.columns.items():
            getattr(out, field)[i, k] *= factor
        return out

    def on_model(self, at: Site, model: Any, theta: jax.Array) -> Any:
        factor = at.values(theta)[:, 0]
        return model.replace(**{f: getattr(model, f).at[at.ids, k].multiply(factor) for f, k in self.columns.items()})

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: the columns, times factor."""
        for actuator, own in with_bias(spec, values):
            for field, k in self.columns.items():
                getattr(actuator, field.removeprefix("actuator_"))[k] *= own["factor"]
        return None


def _alike(gains: np.ndarray) -> dict[str, float]:
    found = {abs(float(x)) for x in gains.ravel()}
    return {"factor": found.pop()} if len(found) == 1 else {}


class OfLoops:
    """What effects on the gains of a declared controller share: `factor` multiplies its number `loop`."""

    loop: ClassVar[str]

    def on_law(self, at: Site, law: Any, theta: jax.Array) -> Any:
        gains = getattr(law, self.loop)
        return law.replace(**{self.loop: gains.at[at.ids].multiply(at.values(theta)[:, 0])})

    @classmethod
    def declared(cls, law: Any, ids: Sequence[int]) -> dict[str, float]:
        """Return {"factor": the gain that logs declare at these actuators}, {} where it is not the same."""
        return {} if law is None else _alike(np.asarray(getattr(law, cls.loop))[..., list(ids)])

    @classmethod
    def carries(cls, model: mujoco.MjModel, i: int) -> bool:
        """Return whether the actuator drives one joint, on whose angle a controller can close its loop."""
        return int(model.actuator_trntype[i]) <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        own = ", ".join(f"{self.loop} of {name} times {own['factor']:.4g}" for name, own in values.items())
        return f"the controller is not the model's but the logs': {own}"


def limits(actuator: Any) -> np.ndarray | None:
    """(lowest, highest) force of a spec's actuator, None where it has no limit."""
    unlimited = actuator.forcelimited == mujoco.mjtLimited.mjLIMITED_FALSE or not np.any(actuator.forcerange)
    return None if unlimited else np.array(actuator.forcerange)


def at_rest(at: Site) -> dict[str, jax.Array]:
    """Memory of a follower of the command before its first command."""
    return {"state": jnp.zeros(len(at)), "fresh": jnp.ones((), bool)}


def follow(at: Site, memory: Any, command: jax.Array, advance: Advance) -> tuple[Any, jax.Array]:
    """Replace the command `[substeps, nu]` by what follows it, at rest at the first command of all.

    Each sub-step applies the follower's mean over the sub-step, so that the impulse is exact.
    """
    own = command[:, at.ids]
    start = jnp.where(memory["fresh"], own[0], memory["state"])
    state, means = jax.lax.scan(advance, start, own)
    return {"state": state, "fresh": jnp.zeros((), bool)}, command.at[:, at.ids].set(means)
