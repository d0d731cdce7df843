"""Runs a blind check: rounds of cases over the cores, each in processes of their own; what was finished stays."""

import dataclasses
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
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


@dataclasses.dataclass(frozen=True)
class Limits:
    """cases: in all; seconds: until no further case is begun, None without end; workers: cases at a time."""

    cases: int
    seconds: float | None = None
    workers: int = 1


def run(check: Check, limits: Limits, say: Say) -> list[Outcome]:
    """Make and diagnose cases up to a number or for a time; the outcomes of all that are finished.

    Raises:
        UserError: what is wrong with model, logs or effects; a seal that is broken.
    """
    check.begin()
    say("measuring what the robot does", 0, 1)
    own = bench(check)
    end = None if limits.seconds is None else time.monotonic() + limits.seconds
    groups, unknown = own.groups(check.effects), own.unknown()
    for indices in rounds(limits.cases):
        before = trials(outcomes(check, range(indices.start), own))
        items = plan(indices, groups, unknown, before, check.seed)
        todo = [i for i in items if not (check.answer(i.index) / EXIT).exists()]
        done = indices.stop - len(todo)
        if todo and not _work_off(check, todo, limits, end, lambda k, d=done: say("cases", d + k, limits.cases)):
            break
    return outcomes(check, range(limits.cases), own)


def _work_off(
    check: Check, items: Sequence[Item], limits: Limits, end: float | None, say: Callable[[int], None]
) -> bool:
    """Whether all items were finished before the time was over."""
    todo: queue.SimpleQueue[Item] = queue.SimpleQueue()
    for item in items:
        todo.put(item)
    answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    count = min(limits.workers, len(items))
    pinned = count > 1 and len(cores) >= count
    workers = [_Worker(check, cores[k] if pinned else None, todo, answers, end) for k in range(count)]
    try:
        finished, idle = 0, 0
        say(0)
        while idle < count:
            answer = answers.get()
            if "error" in answer:
                raise UserError(answer["error"])
            idle += "idle" in answer
            finished += "index" in answer
            say(finished)
    finally:
        for worker in workers:
            worker.stop()
    return finished == len(items)


class _Worker:
    """A process, and the thread that feeds it."""

    def __init__(self, check: Check, core: int | None, todo: Any, answers: Any, end: float | None) -> None:
        self.todo, self.answers, self.end, self.last = todo, answers, end, 0.0
        path = check.folder / f"worker_{0 if core is None else core}.txt"
        self.errors = path.open("w")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bayessim_mjx.blind.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=self.errors, text=True,
        )  # fmt: skip
        self._write(asked(check, core))
        threading.Thread(target=self._feed, args=(path,), daemon=True).start()

    def _write(self, line: str) -> None:
        assert self.process.stdin
        print(line, file=self.process.stdin, flush=True)

    def _feed(self, path: Path) -> None:
        assert self.process.stdout
        while self.end is None or time.monotonic() + self.last < self.end:
            try:
                item = self.todo.get_nowait()
            except queue.Empty:
                break
            try:
                self._write(json.dumps(dataclasses.asdict(item)))
                line = self.process.stdout.readline()
            except OSError:
                line = ""
            if not line:
                self.answers.put({"error": f"case {item.index}: its process died; see {path}"})
                return
            answer = json.loads(line)
            self.last = answer.get("seconds", 0.0)
            self.answers.put(answer)
        self.answers.put({"idle": True})

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
        found.append(Outcome(check.given(index), truth, said, own.scales.drives, told["seconds"]))
    return found


def trials(found: Sequence[Outcome]) -> list[Trial]:
    """Hidden effects of single ones that were diagnosed."""
    singles = [(o, e) for o in found if o.kind == "single" and o.said for e in o.truth["effects"]]
    return [Trial(e["name"], e["where"], max(e["strength"], 1e-3), o.right(e)) for o, e in singles]
