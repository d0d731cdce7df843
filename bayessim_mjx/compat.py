"""Libraries that we build on, where they say or ask what they should not."""

import contextlib
import functools
import io
import types
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import mujoco
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bayessim_mjx import linalg

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on import that the optional warp is absent
    from mujoco import mjx

__all__ = ["brief", "compiler_options", "mass_matrix", "mjx", "program", "put_replicated", "supply"]

CHAIN = 5  # bodies, one after the other, from which on a robot is a long chain
DEEP = 8  # bodies likewise, from which on the options pay for trees with limbs too: they compile faster


class _Instead(types.ModuleType):
    """A module with some of its names replaced."""

    def __init__(self, module: types.ModuleType, **names: Any) -> None:
        super().__init__(module.__name__)
        self._module = module
        vars(self).update(names)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


def _cho_factor(a: jax.Array, *args: Any, **named: Any) -> tuple[jax.Array, bool]:
    """`jax.scipy.linalg.cho_factor`; of small matrices by what `linalg` writes out."""
    if args or named or a.shape[-1] > linalg.UNROLLED:
        return jax.scipy.linalg.cho_factor(a, *args, **named)  # type: ignore[return-value]
    return jnp.swapaxes(linalg.cholesky(a), -1, -2), False


def _cho_solve(factor: tuple[jax.Array, bool], b: jax.Array, **named: Any) -> jax.Array:
    """`jax.scipy.linalg.cho_solve`, likewise."""
    own, lower = factor
    if named or lower or b.ndim != 1 or len(b) > linalg.UNROLLED:
        return jax.scipy.linalg.cho_solve(factor, b, **named)
    return linalg.cholesky_solve(jnp.swapaxes(own, -1, -2), b)


def _write_out_small_factors() -> None:
    """Give MJX's dense factorisations `linalg`'s: a library's make up to a third of a small robot's step.

    A pendulum of two links without friction: 541 ns for a step of one world, 387 with these; a six-joint arm 2386 and
    2117, with dry friction 6993 and 5686 (64 worlds, one core). On an H200 a step of 4096 worlds takes 71 us in place
    of 102, and 161 of 195; with friction 738 of 1000, and 965 of 1213. Fourteen joints gain 3 % and are left alone.
    An MJX that has no such modules keeps its own.
    """
    with contextlib.suppress(ImportError):
        from mujoco.mjx._src import forward, smooth, solver

        own = _Instead(jax.scipy.linalg, cho_factor=_cho_factor, cho_solve=_cho_solve)
        for module in (forward, smooth, solver):
            if getattr(module, "jax", None) is jax:
                module.jax = _Instead(jax, scipy=_Instead(jax.scipy, linalg=own))  # type: ignore[attr-defined]


_write_out_small_factors()


def _axis_angle_to_quat(axis: jax.Array, angle: jax.Array) -> jax.Array:
    """MJX's function of this name, to the bit."""
    half = angle * 0.5
    return jnp.concatenate([jnp.cos(half)[None], axis * jnp.sin(half)])


def _join_quaternions() -> None:
    """Spare MJX the insertion of a number into an array: a scatter, which on a CPU is a loop in every timestep."""
    with contextlib.suppress(ImportError):
        from mujoco.mjx._src import math

        if hasattr(math, "axis_angle_to_quat"):
            math.axis_angle_to_quat = _axis_angle_to_quat


_join_quaternions()


def _end_line_searches() -> None:
    """Let MJX's line search end, on a CPU: under `vmap` its scan computes all `ls_iterations`, whoever needs them.

    MJX scans for reverse derivatives, which its loop of Newton's steps around it does not have. The numbers are the
    same.
    """
    with contextlib.suppress(ImportError):
        from mujoco.mjx._src import solver

        scan = getattr(solver, "_while_loop_scan", None)
        if scan is None:
            return

        def loop(going: Callable[[Any], Any], step: Callable[[Any], Any], start: Any, most: int) -> Any:
            if jax.default_backend() != "cpu":  # an accelerator asks the host before each turn of a loop without count
                return scan(going, step, start, most)
            return jax.lax.while_loop(going, step, start)

        loop.scan = scan  # type: ignore[attr-defined]
        solver._while_loop_scan = loop


_end_line_searches()


def put_replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """Every leaf once per device, along a new leading axis that is spread over them.

    The axis is called i, as Brax's pmap calls it: under another name Brax's epoch would be compiled twice.
    """
    sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))

    def put(x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return jax.device_put(jnp.broadcast_to(x, (len(devices), *x.shape)), sharding)

    return jax.tree.map(put, tree)


def supply() -> None:
    """Give jax >= 0.10 the `device_put_replicated` that Brax 0.14.2, the newest release, calls in its trainers.

    Without it `brax.training.agents.ppo.train` ends with an AttributeError (google/brax#671). Nothing is replaced.
    """
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = put_replicated  # type: ignore[assignment]


@functools.cache
def compiler_options(fused: bool = False, level: int | None = 1) -> dict[str, Any]:
    """Options for `jax.jit` on a CPU; none where the compiler does not know them.

    Args:
        fused: whether XLA's emitters of fusions are used. They make loops of large arrays faster by up to a third and
            compile for twice as long. They may compute shared subexpressions anew in every consumer: for a chain of six
            joints MJX's kinematics then cost 150 times what they should (jaxlib 0.10).

        level: of LLVM's optimisation; None: the last, for programs that run for minutes.

    LLVM's first level compiles in 4/5 of the time of its last, and 40 steps of 64 ants then take .10 CPU seconds in
    place of .17, ten updates of Pendulum's PPO 2.1 in place of 2.3.
    """
    if jax.default_backend() != "cpu":
        return {}
    options: dict[str, Any] = {"xla_cpu_use_fusion_emitters": fused}
    if level is not None and not jax.config.values["jax_disable_most_optimizations"]:  # else somebody has chosen one
        options["xla_backend_optimization_level"] = level
    try:
        jax.jit(lambda x: x + 1).lower(0.0).compile(options)  # unlike a call, also while jax traces another program
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def program(function: Callable[..., Any], env: Any = None, **settings: Any) -> Any:
    """`jax.jit(function, **settings)` of a program that runs for long, with `compiler_options`.

    Bodies as deep in their trees as others are computed together, so that XLA's fusions do not slow down trees with
    several limbs; where the environment's robot is a serial chain, or as deep as a hand on its arm, there are none.
    """
    fused = not _serial(getattr(env, "mj_model", None))
    return _with(lambda: compiler_options(fused), function, settings)


def brief(function: Callable[..., Any], level: int | None = 1, **settings: Any) -> Any:
    """`jax.jit(function, **settings)` of a program that runs for less time than it takes to compile.

    Loops over many small numbers (weighing mixtures) take six times as long. Below its last `level` LLVM rounds as it
    pleases: the same sum in two programs may differ in its last bit.
    """
    return _with(lambda: compiler_options(level=level), function, settings)


def _with(options: Callable[[], dict[str, Any]], function: Callable[..., Any], settings: dict[str, Any]) -> Any:
    """`jax.jit` with compiler options, which are asked for at the first call.

    Inside another program its options hold: jax takes none there.
    """
    inner = jax.jit(function, **settings)

    @functools.cache
    def outer() -> Any:
        return jax.jit(function, compiler_options=options(), **settings)

    @functools.wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        inside = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, named)))
        return (inner if inside else outer())(*args, **named)

    call.lower = lambda *args, **named: outer().lower(*args, **named)  # type: ignore[attr-defined]
    call._cache_size = lambda: outer()._cache_size()  # type: ignore[attr-defined]
    return call


def _serial(model: Any) -> bool:
    parents = getattr(model, "body_parentid", ())
    depth = [0]
    for parent in parents[1:]:
        depth.append(depth[parent] + 1)
    return max(depth) >= DEEP or (max(depth) >= CHAIN and len(parents) - 1 < 2 * max(depth))


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """`[nv, nv]`, by its product with each unit vector (the same call in every MuJoCo)."""
    out = np.zeros((model.nv, model.nv))
    for column, unit in zip(out, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return out
