"""The devices, the processes and the persistent compilation cache, chosen before jax does anything."""

import gc
import os
import re
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from bayessim_mjx.config import loading
from bayessim_mjx.config.settings import Config
from bayessim_mjx.errors import UserError

Item = TypeVar("Item")
Result = TypeVar("Result")
WORLDS = "worlds"  # the only axis of a mesh of devices
PROCESSES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")  # host:port, how many, which of them


def setup_jax(config: Config) -> Any:
    """Make the device of `config` the default and switch the compilation cache on; returns the device.

    Where JAX_COORDINATOR_ADDRESS is set, this process joins the others first (see `jax.distributed`).
    """
    import jax

    match = re.fullmatch(r"(auto(?!:)|cpu|gpu|cuda|rocm|tpu)(?::([0-9]{1,6}))?", config.device)
    if match is None:
        raise UserError(f"device = {config.device!r}: expected auto, cpu, gpu, gpu:1 or cuda:0")
    platform, number = match[1], int(match[2] or 0)
    if platform == "cpu":
        jax.config.update("jax_platforms", "cpu")
    _cache(jax, config.cache_dir)
    _collect_rarely()
    _join(jax)
    devices = _devices(jax, None if platform == "auto" else platform)
    if number >= len(devices):
        there = ", ".join(f"{d.platform}:{d.id}" for d in _devices(jax, None))
        raise UserError(f"device = {config.device!r} is not there; available: {there}")
    if platform != "auto":
        jax.config.update("jax_default_device", devices[number])
    return devices[number]


def _devices(jax: Any, platform: str | None) -> list[Any]:
    try:
        return jax.local_devices(backend=platform)
    except RuntimeError:  # no such backend
        return []


def _join(jax: Any) -> None:
    """Several processes train one policy; their number and place may also come from Slurm or MPI, as jax finds them."""
    address, *numbers = (os.environ.get(name) for name in PROCESSES)
    if not address or jax.distributed.is_initialized():
        return
    for name, number in zip(PROCESSES[1:], numbers, strict=True):
        if number is not None and not re.fullmatch("[0-9]{1,9}", number):
            raise UserError(f"{name} = {number!r}: expected a whole number")
    size, place = (None if number is None else int(number) for number in numbers)
    try:
        jax.distributed.initialize(address, size, place)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"JAX_COORDINATOR_ADDRESS = {address!r}: cannot join the other processes: {error}") from None


def mesh(config: Config) -> Any:
    """Make the mesh of `config.devices` that share the worlds, for `rl.init`; None: one device. After `setup_jax`."""
    import jax

    platform, _, number = config.device.partition(":")
    there = jax.devices(None if platform == "auto" else platform)
    if config.devices != "all" and not re.fullmatch("[0-9]{1,6}", config.devices):
        raise UserError(f"devices = {config.devices!r}: expected all, or how many")
    count = len(there) if config.devices == "all" else int(config.devices)
    if not 1 <= count <= len(there):
        raise UserError(f"devices = {count}: there are {len(there)} ({there[0].platform})")
    if jax.process_count() > 1 and count < len(there):
        raise UserError(f"devices = {count}: {jax.process_count()} processes share all {len(there)}; set devices=all")
    if count > 1 and number:
        raise UserError(f"devices = {count} and device = {config.device!r}: one device is chosen, or several are used")
    return mesh_of(there[:count])


def mesh_of(devices: Sequence[Any]) -> Any:
    """Make the mesh of these devices; None for one."""
    import jax
    import numpy as np
    from jax.sharding import Mesh

    if len(devices) == 1:
        return None
    if devices[0].platform == "gpu" and hasattr(jax.config, "jax_use_shardy_partitioner"):
        # jax 0.11's compiler ends with a segmentation fault in its pass shardy-xla on collection by several GPUs
        jax.config.update("jax_use_shardy_partitioner", False)
    return Mesh(np.array(devices), (WORLDS,))


def _cache(jax: Any, folder: str | None) -> None:
    """Compiled programs survive the process: a second start skips most of the compilation."""
    chosen = folder or os.environ.get(loading.CACHE)
    if chosen == loading.CACHE_OFF:
        return
    path = Path(chosen or f"{loading.CACHE_DEFAULT}/jax").expanduser()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if chosen:
            raise UserError(f"cache_dir = {chosen!r}: cannot be made: {error.strerror}") from None
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # the small ones are many
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _collect_rarely() -> None:
    """Tracing makes objects by the million that live on: looking for garbage among them took a quarter of its time."""
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)


def on_cores(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call `function` on each item, results in order, on as many threads as cores: for work outside Python's lock."""
    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(function, items))


def cores() -> int:
    """Processor cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1
