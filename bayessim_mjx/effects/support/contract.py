"""Effects that users bring are tried once before anything is simulated: they keep the contract, or are refused by name.

What a hook that raises, forgets its `return` or changes the simulator although it is off would do otherwise: end a run
with a traceback out of the compiler, or correct a robot for something that is not there.
"""

import inspect
import traceback
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import overrides
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from mujoco import mjx

    from bayessim_mjx.effects.effect import Effect

LIBRARY = __name__.split(".")[0]
HOOKS = ("on_model", "on_start", "on_record", "on_command", "on_actuator", "on_force", "on_measurement")
ROWS = 3  # of the recording that `on_start` is tried on
_tried: set[tuple] = set()


def brought(effect: "Effect") -> bool:
    """Whether its class is not of this library."""
    module = type(effect).__module__
    return not module.startswith(f"{LIBRARY}.") or ".own_" in module  # as `effects.load` calls a file


def check(effect: "Effect", mj_model: mujoco.MjModel, model: "mjx.Model", substeps: int) -> None:
    """Try all hooks of a user's effect at neutral values and at the ends of its ranges; once per effect and model.

    Raises:
        UserError: naming the effect, the hook and the line: it raises, returns something of another kind, changes its
            input at the neutral values, or gives numbers that are not finite.
    """
    at = _ours(effect, "bind", lambda: effect.bind(mj_model, float(mj_model.opt.timestep), substeps))
    key = (effect, at.names, mj_model.nq, mj_model.nv, mj_model.nu, substeps)
    if key in _tried:
        return
    space = effect.space()
    neutral = [value for block in effect.blocks() for value in block.neutral]
    given = _inputs(at, mj_model)
    for hook in (h for h in HOOKS if overrides(effect, h)):
        call = jax.jit(partial(_called, effect, at, model, hook))
        for what, theta in (("neutral", neutral), ("lowest", space.low), ("highest", space.high)):
            before, after = _ours(effect, hook, partial(call, jnp.asarray(theta, jnp.float32), given))
            _compare(effect, hook, what, before, after)
    _tried.add(key)


def _ours(effect: "Effect", hook: str, call: Any) -> Any:
    """Run the user's code; report whatever it raises, also by `sys.exit`, with its line."""
    try:
        return call()
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        text = f"{type(error).__name__}: {error}".split("\n")[0]
        raise UserError(f"effect {effect.name}: {hook} fails{_line(effect, error)}: {text}") from None


def _line(effect: "Effect", error: BaseException) -> str:
    """Where in the file of the effect's class it went wrong."""
    try:
        file = inspect.getfile(type(effect))
    except (OSError, TypeError):
        return ""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    return f" ({file}, line {lines[-1]})" if lines else ""


def _inputs(at: Site, mj_model: mujoco.MjModel) -> dict[str, Any]:
    """Make the inputs of hooks: a moving robot under a command, and the recording of one."""
    from mujoco import mjx

    rng, data = np.random.default_rng(0), mujoco.MjData(mj_model)
    data.qvel[:] = rng.normal(size=at.nv)
    mujoco.mj_integratePos(mj_model, data.qpos, rng.normal(size=at.nv), 0.1)
    data.ctrl[:] = rng.uniform(-1.0, 1.0, at.nu)
    mujoco.mj_forward(mj_model, data)
    qpos, qvel = jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32)
    command = jnp.asarray(rng.uniform(-1.0, 1.0, (ROWS, at.substeps, at.nu)), jnp.float32)
    return {
        "data": mjx.put_data(mj_model, data, impl="jax"),
        "command": command[0],
        "force": jnp.asarray(data.actuator_force, jnp.float32),
        "measurement": {"qpos": qpos, "qvel": qvel},
        "motion": Motion(jnp.tile(qpos, (ROWS, 1)), jnp.tile(qvel, (ROWS, 1)), command, 1),
    }


def _called(effect: "Effect", at: Site, model: "mjx.Model", hook: str, theta: jax.Array, given: dict) -> tuple:
    """Call a hook: (what it leaves as it is when it is off, its result there)."""
    data, memory = given["data"], effect.init(at)
    shown = given["measurement"]
    step = SubStep(model, data, shown, at.timestep)

    def actuator() -> Any:  # with its derivative, which implicit integrators take
        def own(force: jax.Array) -> Any:
            return effect.on_actuator(at, memory, step, force, theta)

        return jax.jvp(own, (given["force"],), (jnp.ones(at.nu),))[0]

    before, call = {
        "on_model": (model, lambda: (memory, effect.on_model(at, model, theta))),
        "on_start": (given["motion"], lambda: effect.on_start(at, memory, given["motion"], theta)),
        "on_record": (shown, lambda: effect.on_record(at, memory, shown, shown, theta)),
        "on_command": (given["command"], lambda: effect.on_command(at, memory, given["command"], theta)),
        "on_actuator": (given["force"], actuator),
        "on_force": (jnp.zeros(at.nv), lambda: effect.on_force(at, memory, step, theta)),
        "on_measurement": (shown, lambda: effect.on_measurement(at, memory, shown, theta)),
    }[hook]
    result = call()
    if not (isinstance(result, tuple) and len(result) == 2):
        raise UserError(f"effect {effect.name}: {hook} returns {_kind(result)}; expected (memory, {_kind(before)})")
    for what, old, new in (("memory", memory, result[0]), ("result", before, result[1])):
        if _shapes(old) != _shapes(new):
            raise UserError(f"effect {effect.name}: {hook}: its {what} is {_kind(new)}; expected {_kind(old)}")
    return before, result[1]


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return [jnp.shape(leaf) for leaf in leaves], structure


def _kind(tree: Any) -> str:
    """In a few words."""
    leaves = jax.tree.leaves(tree)
    if len(leaves) == 1 and hasattr(tree, "shape"):
        return f"an array {list(jnp.shape(tree))}"
    return {
        "NoneType": "nothing (a missing return?)",
        "tuple": f"{len(tree) if isinstance(tree, tuple) else 0} values",
    }.get(type(tree).__name__, type(tree).__name__)


def _compare(effect: "Effect", hook: str, what: str, before: Any, after: Any) -> None:
    for old, new in zip(map(np.asarray, jax.tree.leaves(before)), map(np.asarray, jax.tree.leaves(after)), strict=True):
        if what == "neutral" and not np.array_equal(old, new, equal_nan=old.dtype.kind == "f"):
            gap = np.max(np.abs(np.float64(new) - np.float64(old)))
            text = (
                f"at the neutral values {hook} changes its input, by {gap:.3g}; an effect that is off changes nothing"
            )
            raise UserError(f"effect {effect.name}: {text}")
        if np.isfinite(old).all() and not np.isfinite(new).all():
            text = f"{hook} gives numbers that are not finite at the {what} values of its ranges"
            raise UserError(f"effect {effect.name}: {text}")
