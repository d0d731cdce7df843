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
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from bayessim_mjx import device
from bayessim_mjx.blind import seal
from bayessim_mjx.blind.cases import Item
from bayessim_mjx.blind.check import Bench, Check, bench
from bayessim_mjx.blind.cores import Cores, allowed, shares
from bayessim_mjx.blind.curves import Trial
from bayessim_mjx.blind.outcome import Outcome
from bayessim_mjx.blind.plan import AT_ONCE, known, plan, rounds
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
    say("measuring what the robot does", 0, 1)
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
