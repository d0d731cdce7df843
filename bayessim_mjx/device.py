"""The device and the persistent compilation cache, chosen before jax does anything."""

import functools
import os
import re
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.settings import Config

CACHE_VARIABLE = "BAYESSIM_MJX_CACHE"


def setup_jax(config: Config) -> Any:
    """Make the device of `config` the default and switch the compilation cache on; returns the device."""
    import jax

    match = re.fullmatch(r"(auto(?!:)|cpu|gpu|cuda|rocm|tpu)(?::(\d+))?", config.device)
    if match is None:
        raise UserError(f"device = {config.device!r}: expected auto, cpu, gpu, gpu:1 or cuda:0")
    platform, number = match[1], int(match[2] or 0)
    if platform == "cpu":
        jax.config.update("jax_platforms", "cpu")
    _cache(jax, config.cache_dir)
    devices = _devices(jax, None if platform == "auto" else platform)
    if number >= len(devices):
        there = ", ".join(f"{d.platform}:{d.id}" for d in _devices(jax, None))
        raise UserError(f"device = {config.device!r} is not there; available: {there}")
    if platform != "auto":
        jax.config.update("jax_default_device", devices[number])
    return devices[number]


def _devices(jax: Any, platform: str | None) -> list[Any]:
    try:
        return jax.devices(platform)
    except RuntimeError:  # no such backend
        return []


def _cache(jax: Any, folder: str | None) -> None:
    """Compiled programs survive the process: a second start skips most of the compilation."""
    chosen = folder or os.environ.get(CACHE_VARIABLE)
    if chosen == "off":
        return
    path = Path(chosen or "~/.cache/bayessim_mjx/jax").expanduser()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if chosen:
            raise UserError(f"cache_dir = {chosen!r}: cannot be made: {error.strerror}") from None
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


@functools.cache
def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit` of programs with kinematic chains; none where the compiler does not know them.

    XLA's fusion on CPU may compute shared subexpressions anew in every consumer: for a chain of six joints MJX's
    kinematics then cost 150 times what they should (jaxlib 0.10).
    """
    import jax

    options = {"xla_cpu_use_fusion_emitters": False}
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(0.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def cores() -> int:
    """Processor cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1
