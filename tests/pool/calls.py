"""What processes of a pool are given to do in tests."""

import os
import signal
import time
from pathlib import Path


def square(x: int) -> int:
    return x * x


def dies_once(folder: Path, x: int) -> int:
    """The process kills itself, except where it did so at this call before."""
    mark = folder / str(x)
    if not mark.exists():
        mark.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return x * x


def dies(x: int) -> None:
    time.sleep(1.0)  # Dask gives up a worker that dies while it starts
    os.kill(os.getpid(), signal.SIGKILL)


def fails(x: int) -> None:
    raise ValueError(f"{x} is wrong")


def process(seconds: float = 0.0, file: Path | None = None) -> int:
    """Its process, which is written into the file at once."""
    if file:
        file.write_text(str(os.getpid()))
    time.sleep(seconds)
    return os.getpid()
