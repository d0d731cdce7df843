"""What all tests share: a compiler that is quick about it, chosen before jax starts one."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

# The suite's time is XLA's: without fusion emitters it compiles a control step in two thirds of the time.
QUICK = "--xla_cpu_use_fusion_emitters=false"


def known(flag: str) -> bool:
    """Whether this jaxlib knows the flag: of one that it does not know it would die."""
    code = "import jax; jax.jit(lambda x: x + 1)(0.0)"
    environment = {**os.environ, "XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0


# Set by hand, also to nothing, it stays: CI runs its slow tests with the compiler as users have it. Workers inherit it.
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = QUICK if known(QUICK) else ""


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
