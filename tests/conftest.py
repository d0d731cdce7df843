"""What all tests share: a compiler that is quick about it, chosen before jax starts one, and what it compiled."""

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# The suite's time is XLA's: without fusion emitters it compiles a control step in two thirds of the time; programs that
# are not cut into parts for threads, of which two workers leave none idle, in a tenth less.
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"


def known(flag: str) -> bool:
    """Whether this jaxlib knows the flag: of one that it does not know it would die."""
    code = "import jax; jax.jit(lambda x: x + 1)(0.0)"
    environment = {**os.environ, "XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0


# Set by hand, also to nothing, it stays: CI runs its slow tests with the compiler as users have it. Workers inherit it.
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = QUICK if known(QUICK) else ""
# Most programs run for milliseconds and compile for seconds, so none is optimised: half the time, also of long fits.
if os.environ["XLA_FLAGS"] == QUICK:
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

# Programs are compiled once for all workers, subprocesses and later runs, also those that take milliseconds.
KEPT = Path(__file__).resolve().parents[1] / ".pytest_cache" / "xla"
MOST = 2**30  # bytes; programs of tests long changed are never asked for again
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    KEPT.mkdir(parents=True, exist_ok=True)
    if "PYTEST_XDIST_WORKER" not in os.environ and sum(f.stat().st_size for f in KEPT.iterdir()) > MOST:
        shutil.rmtree(KEPT)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(KEPT)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("BAYESSIM_MJX_CACHE", os.environ["JAX_COMPILATION_CACHE_DIR"])

os.environ.pop("COLUMNS", None)  # commands would break their lines there, and tests look for what they say

# Where a program's lines come from is of no interest here, and costs a tenth of the time that tracing takes.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

# Tracing makes objects by the million that live on; looking for garbage among them took a quarter of its time.
gc.set_threshold(100_000, 50, 100)


def pytest_collection_finish() -> None:
    gc.freeze()


MAPS = 20_000  # regions of memory; Linux gives a process 65530, and a compiler that gets no more of them crashes


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    """What was compiled is forgotten after a file of tests, where there is much of it."""
    yield
    maps = Path("/proc/self/maps")
    if maps.is_file() and len(maps.read_bytes().splitlines()) > MAPS:
        import jax

        jax.clear_caches()
        gc.collect()


@pytest.fixture
def strict():
    """No silent promotion of types or broadcasting of ranks."""
    import jax

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield
