"""Runs an entry: a process that cannot read the truths, with what it cost."""

import dataclasses
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from bayessim_mjx.blind import confine

STOPPED = (130, -signal.SIGINT, -signal.SIGTERM)  # by somebody: to be run again
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)
LATE = 124  # exit status of what was ended for its time, as of `timeout`
QUIET = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}


@dataclasses.dataclass(frozen=True)
class Ended:
    """Exit status, negative for a signal; seconds by the clock; cpu: s of the process and all that it waited for."""

    code: int
    seconds: float
    cpu: float


def apart() -> bool:
    """Whether this system can keep an entry from reading the truths."""
    return confine.version() > 0


def run(
    words: Sequence[str], folder: Path, output: IO[str], timeout: float, hidden: Path | None = None,
    remote: bool = False,
) -> Ended:  # fmt: skip
    """Run a program in a folder; it ends with this process.

    Args:
        words: the program and its arguments; output: takes what it prints; timeout: s, after which it is killed.
        hidden: a folder of which it can read no file, where the system can do that; None: it can read everything.
        remote: with `hidden`, it can open no TCP connection either (Linux 6.7 and newer): by one, a program reaches
            the workers of a cluster, which run what they get and read everything.

    Raises:
        OSError: there is no such program.
    """
    scratch = folder / "tmp"
    scratch.mkdir(exist_ok=True)
    if not shutil.which(words[0]):
        raise FileNotFoundError(words[0])
    if sys.platform.startswith("linux"):
        kept = str(hidden.resolve()) if hidden and apart() else ""
        words = [sys.executable, "-I", confine.__file__, kept, "alone" if remote else "", *words]
    started = time.perf_counter()
    process = subprocess.Popen(
        words, cwd=folder, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
        env=os.environ | QUIET | {"TMPDIR": str(scratch)},
    )  # fmt: skip
    late = threading.Event()
    clock = threading.Timer(timeout, _end, (process.pid, late))
    clock.start()
    try:
        cpu = _waited(process)
    except BaseException:
        process.kill()
        process.wait()
        raise
    finally:
        clock.cancel()
    return Ended(LATE if late.is_set() else process.returncode, time.perf_counter() - started, cpu)


def _end(pid: int, late: threading.Event) -> None:
    late.set()
    os.kill(pid, KILL)


def _waited(process: subprocess.Popen[bytes]) -> float:
    """Wait for a process; s of CPU that it took, nan where the system does not tell."""
    if not hasattr(os, "wait4"):
        process.wait()
        return math.nan
    _, status, used = os.wait4(process.pid, 0)  # the system gives what it cost once, to who waits for it
    process.returncode = os.waitstatus_to_exitcode(status)
    return used.ru_utime + used.ru_stime
