"""Processes of this machine as a `concurrent.futures.Executor`: one that dies is replaced, and its call runs again."""

import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.pool.cores import Cores, allowed, shares

FORGIVEN = 3  # deaths of processes at the same call; Dask's `allowed-failures` has this value too

GRACE = 2.0  # s, for a call to end what it has started


class Stopping(Executor):
    """An executor whose block, left by an error, does not wait for calls that nobody needs any more."""

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.shutdown(wait=kind is None)


class Processes(Stopping):
    """A pool whose workers are a thread and a process each.

    `concurrent.futures.ProcessPoolExecutor` ends all its processes when one of them dies. Here every process is such a
    pool of its own, so the others go on. A process begins with its first call and lives until the end.

    Args:
        workers: how many; folder: takes what they print, as worker_K.txt. None: they print where this process does.
        share: whether each has cores of its own, which others get while it waits.
    """

    def __init__(self, workers: int, folder: Path | None = None, share: bool = True) -> None:
        self.folder, self._threads, self._own = folder, ThreadPoolExecutor(workers), threading.local()
        self._cores, self._numbers = Cores(shares(allowed(), workers) if share else []), itertools.count()
        self._pools, self._pids = dict[int, ProcessPoolExecutor](), dict[int, int]()
        self._waiting, self._over, self._lock = 0, False, threading.Lock()

    def submit(self, function: Callable[..., Any], /, *args: Any, **options: Any) -> Future[Any]:
        with self._lock:
            self._waiting += 1
        future = self._threads.submit(self._call, partial(function, *args, **options))
        future.add_done_callback(lambda ended: self._begun() if ended.cancelled() else None)
        return future

    def _begun(self) -> None:
        with self._lock:
            self._waiting -= 1

    def _call(self, function: Callable[[], Any]) -> Any:
        """Run a call in the process of this thread, again where the process dies or somebody stops the call."""
        self._begun()
        if not hasattr(self._own, "number"):
            self._own.number = next(self._numbers)
        number = self._own.number
        for _ in range(FORGIVEN + 1):
            try:
                pool = self._pools.get(number) or self._started(number)
                self._cores.working(number, self._pids[number])
                return pool.submit(function).result()
            except (BrokenProcessPool, KeyboardInterrupt):
                if self._over:
                    raise
                self._pools.pop(number).shutdown()
            finally:
                if not self._waiting:  # its cores go to the others; else its next call begins at once
                    self._cores.working(number, None)
        said = f"; see {self._output(number)}" if self.folder else ""
        raise UserError(f"its process died {FORGIVEN + 1} times, perhaps for lack of memory{said}")

    def _output(self, number: int) -> Path | None:
        return self.folder / f"worker_{number}.txt" if self.folder else None

    def _started(self, number: int) -> ProcessPoolExecutor:
        given = (self._output(number), self._cores.environment())
        self._pools[number] = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, given)
        self._pids[number] = self._pools[number].submit(os.getpid).result()
        if self._over:
            raise BrokenProcessPool
        return self._pools[number]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the processes end: when all calls are done, or without `wait` at once, whatever they do."""
        if not wait:
            self._over = True
            self._threads.shutdown(wait=False, cancel_futures=True)
            for number in list(self._pools):
                with contextlib.suppress(ProcessLookupError, KeyError):
                    os.kill(self._pids[number], signal.SIGTERM)
        self._threads.shutdown(cancel_futures=cancel_futures)
        for pool in self._pools.values():
            pool.shutdown()


def _begin(output: Path | None, environment: dict[str, str]) -> None:
    """Set up a process of the pool."""
    os.environ.update(environment)
    if output:
        with output.open("a") as text:
            os.dup2(text.fileno(), 1)
            os.dup2(text.fileno(), 2)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of Ctrl-C the pool hears, and ends its processes
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that a call can end what it has started
    threading.Thread(target=_end_with_the_pool, daemon=True).start()


def _end_with_the_pool() -> None:
    """Wait until the pool's process is gone, also by SIGKILL; then stop the call and end."""
    if parent := multiprocessing.parent_process():
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
        os._exit(1)
