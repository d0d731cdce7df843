"""Runs a blind check: rounds of cases over the cores, each in processes of their own; what was finished stays."""

import dataclasses
import json
import math
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from bayessim_mjx.blind import seal
from bayessim_mjx.blind.cases import Item
from bayessim_mjx.blind.check import Bench, Check, bench
from bayessim_mjx.blind.curves import Trial
from bayessim_mjx.blind.outcome import Outcome
from bayessim_mjx.blind.plan import plan, rounds
from bayessim_mjx.blind.worker import EXIT, KEPT, asked
from bayessim_mjx.errors import UserError

Say = Callable[[str, int, int], None]
Between = Callable[[list[Outcome]], None]


@dataclasses.dataclass(frozen=True)
class Limits:
    """cases: in all; seconds: until no further case is begun, None without end; workers: cases at a time."""

    cases: int
    seconds: float | None = None
    workers: int = 1


def run(check: Check, limits: Limits, say: Say, between: Between = lambda outcomes: None) -> list[Outcome]:
    """Make and diagnose cases up to a number or for a time; the outcomes of all that are finished.

    `between` gets the outcomes so far after every round but the last.

    Raises:
        UserError: what is wrong with model, logs or effects; a seal that is broken.
    """
    check.begin()
    say("measuring what the robot does", 0, 1)
    own = bench(check)
    groups, unknown = own.groups(check.effects), own.unknown()
    crew = _Crew(check, limits)
    try:
        for indices in rounds(limits.cases):
            so_far = outcomes(check, range(indices.start), own)
            before = trials(so_far)
            items = plan(indices, groups, unknown, before, check.seed)
            todo = [i for i in items if not (check.answer(i.index) / EXIT).exists()]
            told = partial(_told, say, indices.stop - len(todo), limits.cases)
            if todo and so_far:
                between(so_far)
            if todo and not crew.work_off(todo, told):
                break
    finally:
        crew.stop()
    return outcomes(check, range(limits.cases), own)


def _told(say: Say, before: int, total: int, done: int) -> None:
    say("cases", before + done, total)


class _Crew:
    """Workers that stay from round to round; none is started before there is something to do."""

    def __init__(self, check: Check, limits: Limits) -> None:
        self.check, self.workers = check, list[_Worker]()
        self.end = None if limits.seconds is None else time.monotonic() + limits.seconds
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        pinned = 1 < limits.workers <= len(cores)
        self.cores = [cores[k] if pinned else None for k in range(limits.workers)]

    def work_off(self, items: Sequence[Item], say: Callable[[int], None]) -> bool:
        """Whether all items were finished before the time was over.

        Raises:
            UserError: what is wrong with the robot or the entry, or where a worker says why it died.
        """
        todo: queue.SimpleQueue[Item] = queue.SimpleQueue()
        for item in items:
            todo.put(item)
        answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        count = min(len(self.cores), len(items))
        for k in range(len(self.workers), count):
            self.workers.append(_Worker(self.check, k, self.cores[k], self.end))
        for worker in self.workers[:count]:
            threading.Thread(target=worker.feed, args=(todo, answers), daemon=True).start()
        finished, idle = 0, 0
        say(0)
        while idle < count:
            answer = answers.get()
            if "error" in answer:
                raise UserError(answer["error"])
            idle += "idle" in answer
            finished += "index" in answer
            say(finished)
        return finished == len(items)

    def stop(self) -> None:
        for worker in self.workers:
            worker.stop()


class _Worker:
    """A process that makes and diagnoses cases, see `worker`; `last`: s that its last case took."""

    def __init__(self, check: Check, number: int, core: int | None, end: float | None) -> None:
        self.end, self.last = end, 0.0
        self.path = check.folder / f"worker_{number}.txt"
        self.errors = self.path.open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bayessim_mjx.blind.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=self.errors, text=True,
        )  # fmt: skip
        self._write(asked(check, core))

    def _write(self, line: str) -> None:
        assert self.process.stdin
        print(line, file=self.process.stdin, flush=True)

    def feed(self, todo: Any, answers: Any) -> None:
        """Give it one item after the other, until there is none or no time; all that it answers goes to `answers`."""
        assert self.process.stdout
        while self.end is None or time.monotonic() + self.last < self.end:
            try:
                item = todo.get_nowait()
            except queue.Empty:
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
        answers.put({"idle": True})

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
    """The finished cases, their seals opened.

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
        told = json.loads(ended.read_text())
        seals = {str(check.seal(index)): check.seal(index).read_text(), str(ended): told["seal"]}
        truth = seal.opened(check.given(index), secret, seals)
        answer = next((p for p in (check.answer(index) / n for n in KEPT) if p.exists()), None)
        said = json.loads(answer.read_text()) if answer and told["code"] == 0 else None
        truth["closed"] = told.get("closed")
        cpu = told.get("cpu", math.nan)
        found.append(Outcome(check.given(index), truth, said, own.scales.drives, told["seconds"], cpu))
    return found


def trials(found: Sequence[Outcome]) -> list[Trial]:
    """Hidden effects of single ones that were diagnosed."""
    singles = [(o, e) for o in found if o.kind == "single" and o.said for e in o.truth["effects"]]
    return [Trial(e["name"], e["where"], max(e["strength"], 1e-3), o.right(e)) for o, e in singles]
