"""A command on a core that no other one has, as a call for an executor."""

import contextlib
import fcntl
import math
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from bayessim_mjx.pool.cores import allowed


def alone(
    words: Sequence[str], output: Path, end: float = math.inf, extra: Mapping[str, str] | None = None, pin: bool = True
) -> int | None:
    """Run a command in a session of its own; its exit status, negative for a signal, or None if it was not begun.

    Args:
        words: the command; output: file that takes what it prints; extra: environment variables beside those here.
        end: s since the epoch, when it is killed; pin: whether it runs on a core that no other such command has.
    """
    if time.time() >= end:
        return None
    before = os.sched_getaffinity(0) if pin and hasattr(os, "sched_setaffinity") else set[int]()
    with _core() if before else contextlib.nullcontext() as core, output.open("w") as text:
        if core is not None:
            os.sched_setaffinity(0, {core})  # of this thread, and of what it starts
        try:
            process = subprocess.Popen(
                words, stdout=text, stderr=subprocess.STDOUT, env=os.environ | dict(extra or {}), start_new_session=True
            )
        finally:
            if core is not None:
                os.sched_setaffinity(0, before)
        try:
            return process.wait(end - time.time() if end < math.inf else None)
        except subprocess.TimeoutExpired:
            return -signal.SIGKILL
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextlib.contextmanager
def _core() -> Iterator[int | None]:
    """Take a core that no other process has taken; None: all are. A process that is killed leaves its core free."""
    folder = Path(tempfile.gettempdir()) / f"bayessim_mjx_cores_{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for core in allowed():
        with (folder / str(core)).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield core
            return
    yield None
