"""Cores of the processes of a pool: each has its own, and those of processes without work go to the others."""

import itertools
import os
import threading
from collections.abc import Collection, Sequence
from pathlib import Path

POOL = "NPROC"  # by which XLA keeps so many threads, whatever cores it may use at its start
MOST = 32  # of these threads


def allowed() -> list[int]:
    """Cores that this process may use; none where the system does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def shares(cores: Sequence[int], workers: int) -> list[list[int]]:
    """Share out cores to workers; none where there is one worker, or fewer cores than workers: each runs on all."""
    return _split(cores, workers) if 1 < workers <= len(cores) else [[] for _ in range(workers)]


def lent(own: Sequence[Sequence[int]], busy: Collection[int]) -> dict[int, list[int]]:
    """Give each worker with work its own cores and an even share of those whose workers have none."""
    spare = [core for k, cores in enumerate(own) if k not in busy for core in cores]
    return {k: [*own[k], *more] for k, more in zip(sorted(busy), _split(spare, len(busy)), strict=True)}


def _split(cores: Sequence[int], parts: int) -> list[list[int]]:
    ends = [k * len(cores) // max(parts, 1) for k in range(parts + 1)]
    return [list(cores[a:b]) for a, b in itertools.pairwise(ends)]


def move(process: int, cores: Collection[int]) -> None:
    """Have a process, all that it started and all their threads run on these cores; who ends meanwhile is left out."""
    children = dict[int, list[int]]()
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_bytes().rpartition(b")")[2].split()[1])  # after the name, which may be anything
        except OSError:
            continue
        children.setdefault(parent, []).append(int(status.parent.name))
    processes = [process]
    for one in processes:
        processes += children.get(one, [])
        for thread in Path(f"/proc/{one}/task").glob("*"):
            try:
                os.sched_setaffinity(int(thread.name), cores)
            except OSError:
                continue


class Cores:
    """Which cores each worker has at a time.

    Args:
        own: cores of each worker, see `shares`; without any, nobody is moved.
    """

    def __init__(self, own: Sequence[Sequence[int]]) -> None:
        self.own, self._lock = own, threading.Lock()  # each worker is fed by a thread of its own
        self._working, self._given = dict[int, int](), dict[int, list[int]]()

    def environment(self) -> dict[str, str]:
        """List the environment variables that a worker needs so that it can use cores lent to it later."""
        cores = sum(map(len, self.own))
        return {POOL: str(min(cores, MOST))} if cores else {}

    def working(self, worker: int, process: int | None) -> None:
        """Mark a worker as busy in this process from now on; None: it waits."""
        if not any(self.own):
            return
        with self._lock:
            self._working.pop(worker, None)
            if process is not None:
                self._working[worker] = process
            given = lent(self.own, self._working)
            for k, cores in given.items():
                if self._given.get(k) != cores:
                    move(self._working[k], cores)
            self._given = given
