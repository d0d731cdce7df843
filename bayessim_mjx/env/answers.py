"""What the methods of a task have to return: anything else is refused with the method's name and what it returned."""

from collections.abc import Mapping
from typing import Any, NoReturn

import jax
import jax.numpy as jnp

from bayessim_mjx.errors import UserError


def rewarded(task: str, given: Any) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
    """Return what `reward` gave: (reward, terminated, metrics), numbers of one world.

    Raises:
        UserError: it is something else.
    """
    needed = "(reward, terminated, metrics): two numbers and a dictionary of numbers, {} for none"
    if not (isinstance(given, tuple | list) and len(given) == 3 and isinstance(given[2], Mapping)):
        _refuse(task, "reward", given, needed)
    if any(jnp.shape(x) != () for x in (*given[:2], *given[2].values())):
        _refuse(task, "reward", given, needed)
    if jnp.issubdtype(jnp.result_type(given[1]), jnp.inexact):
        raise UserError(
            f"task {task}: `terminated` of `reward` is {jnp.result_type(given[1])}, but has to be bool, as "
            "height < 0.2 is, or terminated > 0 (docs/own_task.md)"
        )
    return tuple(given)


def observed(task: str, given: Any) -> dict[str, jax.Array]:
    """Return what `observe` gave: groups of observations, "policy" among them.

    Raises:
        UserError: it is something else.
    """
    if not isinstance(given, Mapping) or "policy" not in given or any(jnp.ndim(x) != 1 for x in given.values()):
        _refuse(task, "observe", given, '{"policy": observation}, a dictionary of vectors')
    return dict(given)


def begun(task: str, given: Any, nq: int, nv: int) -> tuple[jax.Array, jax.Array]:
    """Return what `initial` gave: (qpos `[nq]`, qvel `[nv]`).

    Raises:
        UserError: it is something else.
    """
    if not isinstance(given, tuple | list) or [jnp.shape(x) for x in given] != [(nq,), (nv,)]:
        _refuse(task, "initial", given, f"(qpos, qvel), of {nq} and {nv} numbers")
    return tuple(given)


def commanded(task: str, given: Any, nu: int) -> jax.Array:
    """Return what `command` or `actuate` gave: a number for each actuator.

    Raises:
        UserError: it is something else.
    """
    if jnp.shape(given) != (nu,):
        _refuse(task, "command", given, f"one command for each actuator, a vector of {nu}")
    return given


def _refuse(task: str, method: str, given: Any, needed: str) -> NoReturn:
    raise UserError(f"task {task}: `{method}` returned {_told(given)}, but has to return {needed} (docs/own_task.md)")


def _told(given: Any) -> str:
    """Describe a value by its kind and shape."""
    if isinstance(given, Mapping):
        return "{" + ", ".join(f"{name!r}: {_told(x)}" for name, x in given.items()) + "}"
    if isinstance(given, tuple | list):
        return "(" + ", ".join(map(_told, given)) + ")"
    if given is None:
        return "None"
    try:
        shape = jnp.shape(given)
    except TypeError:
        return f"a {type(given).__name__}"
    return "a number" if shape == () else f"an array of shape {list(shape)}"
