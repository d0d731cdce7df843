"""Runs a blind check: rounds of cases over the cores, each in processes of their own; what was finished stays."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bayessim_mjx import device
from bayessim_mjx.blind import seal
from bayessim_mjx.blind.cases import AT_ONCE, Item, known, plan, rounds
from bayessim_mjx.blind.check import Bench, Check, bench
from bayessim_mjx.blind.curves import Trial
from bayessim_mjx.blind.outcome import Outcome
from bayessim_mjx.blind.worker import EXIT, KEPT, asked
from bayessim_mjx.errors import UserError

Say = Callable[[str, int, int], None]
Between = Callable[[list[Outcome]], None]


@dataclasses.dataclass(frozen=True)
class Limits:
    """cases: in all; seconds: until no further case is begun, None without end.

    workers: cases at a time; None: as many as cores, up to those that need not wait for others.
    """

    cases: int
    seconds: float | None = None
    workers: int | None = 1


def run(check: Check, limits: Limits, say: Say, between: Between = lambda outcomes: None) -> list[Outcome]:
    """Make and diagnose cases up to a number or for a time; the outcomes of all that are finished.

    `between` gets the outcomes so far when a round of cases has been begun.

    Raises:
        UserError: what is wrong with model, logs or effects; a seal that is broken.
    """
    check.begin()
    say("measuring the robot's motion", 0, 1)
    own = bench(check)
    groups, unknown = own.groups(check.effects), own.unknown()
    done = {i for i in range(limits.cases) if (check.answer(i) / EXIT).exists()}
    crew = _Crew(check, limits, done, partial(_told, say, limits.cases))
    try:
        for indices in rounds(limits.cases):
            if not crew.until(range(known(indices))):
                break
            so_far = outcomes(check, range(indices.start), own)
            before = trials([o for o in so_far if o.truth["index"] < known(indices)])
            todo = [i for i in plan(indices, groups, unknown, before, check.seed) if i.index not in done]
            crew.begin(todo)
            if todo and before:
                between(so_far)
        crew.until(range(limits.cases))
    finally:
        crew.stop()
    return outcomes(check, range(limits.cases), own)


def _told(say: Say, total: int, done: int) -> None:
    say("cases", done, total)


class _Crew:
    """Workers that take cases as they are given; none is started before there is something to do.

    done: indices of the cases that are finished; it grows.
    """

    def __init__(self, check: Check, limits: Limits, done: set[int], say: Callable[[int], None]) -> None:
        self.check, self.workers, self.done, self.say = check, list[_Worker](), done, say
        self.end = None if limits.seconds is None else time.monotonic() + limits.seconds
        self.cores = Cores(shares(allowed(), limits.workers or min(device.cores(), AT_ONCE)))
        self.todo: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self.answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.given, self.idle = 0, 0

    def begin(self, items: Iterable[Item]) -> None:
        """Have these done, in their order."""
        for item in items:
            self.todo.put(item)
            self.given += 1
        for k in range(len(self.workers), min(len(self.cores.own), self.given)):
            self.workers.append(_Worker(self.check, k, self.cores, self.end))
            threading.Thread(target=self.workers[k].feed, args=(self.todo, self.answers), daemon=True).start()
        self.say(len(self.done))

    def until(self, indices: range) -> bool:
        """Whether these cases, of those that were given, were finished before the time was over.

        Raises:
            UserError: what is wrong with the robot or the entry, or where a worker says why it died.
        """
        while not self.done.issuperset(indices) and self.idle < len(self.workers):
            answer = self.answers.get()
            if "error" in answer:
                raise UserError(answer["error"])
            self.idle += "idle" in answer
            if "index" in answer:
                self.done.add(answer["index"])
                self.say(len(self.done))
        return self.done.issuperset(indices)

    def stop(self) -> None:
        for _ in self.workers:
            self.todo.put(None)
        for worker in self.workers:
            worker.stop()


class _Worker:
    """A process that makes and diagnoses cases, see `worker`; `last`: s that its last case took."""

    def __init__(self, check: Check, number: int, cores: Cores, end: float | None) -> None:
        self.end, self.last, self.number, self.cores = end, 0.0, number, cores
        self.path = check.folder / f"worker_{number}.txt"
        self.errors = self.path.open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bayessim_mjx.blind.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=self.errors, text=True, env=os.environ | cores.environment(),
        )  # fmt: skip
        self._write(asked(check))

    def _write(self, line: str) -> None:
        assert self.process.stdin
        print(line, file=self.process.stdin, flush=True)

    def feed(self, todo: Any, answers: Any) -> None:
        """Give it one item after the other, until None or for lack of time; all that it answers goes to `answers`."""
        assert self.process.stdout
        while (item := self._next(todo)) is not None:
            if self.end is not None and time.monotonic() + self.last >= self.end:
                todo.put(item)  # whoever waits for one is to see that there is no time
                break
            try:
                self._write(json.dumps(dataclasses.asdict(item)))
                line = self.process.stdout.readline()
            except OSError:
                line = ""
            if not line:
                answers.put({"error": f"case {item.index}: its process died; see {self.path}"})
                return
            answer = json.loads(line)
            self.last = answer.get("seconds", 0.0)
            answers.put(answer)
        self.cores.working(self.number, None)
        answers.put({"idle": True})

    def _next(self, todo: Any) -> Any:
        """Take the next item; while there is none, its cores go to the workers that have one."""
        if todo.empty():
            self.cores.working(self.number, None)
        item = todo.get()
        self.cores.working(self.number, self.process.pid)
        return item

    def stop(self) -> None:
        """Let the process end: at once where it waits, else it is ended."""
        assert self.process.stdin
        self.process.stdin.close()
        try:
            self.process.wait(0.5)
        except subprocess.TimeoutExpired:
            self.process.terminate()
            self.process.wait()
        self.errors.close()


def outcomes(check: Check, indices: range, own: Bench) -> list[Outcome]:
    """Collect the finished cases, their seals opened.

    Raises:
        UserError: a seal is broken.
    """
    found = []
    for index in indices:
        ended, secret = check.answer(index) / EXIT, check.secret(index)
        if not ended.exists():
            continue
        if not secret.exists():
            raise UserError(f"{secret}: no such file; the truth of a finished case is gone, make the check again")
        report = json.loads(ended.read_text())
        seals = {str(check.seal(index)): check.seal(index).read_text(), str(ended): report["seal"]}
        truth = seal.opened(check.given(index), secret, seals)
        answer = next((p for p in (check.answer(index) / n for n in KEPT) if p.exists()), None)
        said = json.loads(answer.read_text()) if answer and report["code"] == 0 else None
        truth["closed"] = report.get("closed")
        cpu = report.get("cpu", math.nan)
        found.append(Outcome(check.given(index), truth, said, own.scales.drives, report["seconds"], cpu))
    return found


def trials(found: Sequence[Outcome]) -> list[Trial]:
    """Hidden effects of single ones that were diagnosed."""
    singles = [(o, e) for o in found if o.kind == "single" and o.said for e in o.truth["effects"]]
    return [Trial(e["name"], e["where"], max(e["strength"], 1e-3), o.right(e)) for o, e in singles]


# Cores of the workers of a blind check: each has its own, and those of workers without work go to the others


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
