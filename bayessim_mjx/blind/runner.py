"""Runs a blind check: rounds of cases, each in a process of its own; what was finished stays."""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

from bayessim_mjx import device, pool
from bayessim_mjx.blind import process, seal
from bayessim_mjx.blind.cases import AT_ONCE, Item, known, plan, rounds
from bayessim_mjx.blind.check import Bench, Check, bench
from bayessim_mjx.blind.curves import Trial
from bayessim_mjx.blind.outcome import Outcome
from bayessim_mjx.blind.worker import EXIT, KEPT, Terms, work
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import count, duration

# s by the clock of a case of one worker: benchmarks/records/blind_cost.json, 100 cases in 26 min by two workers, of
# pendulum and two-link arm. Six joints took twenty times as long there
CASE = 32.0
Say = Callable[[str, int, int], None]
Between = Callable[[list[Outcome]], None]
SEEN = 120.0  # s, in which a file of another machine has to be seen here: NFS looks again after 60 (nfs(5), acdirmax)


@dataclasses.dataclass(frozen=True)
class Limits:
    """cases: in all; seconds: until no further case is begun, None without end.

    workers: cases at a time; None: as many as cores, up to those that need not wait for others.
    cluster: which processes do the work, see `pool.executor`.
    """

    cases: int
    seconds: float | None = None
    workers: int | None = 1
    cluster: str = ""


def estimate(check: Check, limits: Limits) -> str:
    """Say how long the cases that are missing take: by those that are finished, else as recorded.

    Of machines of a cluster, or of another diagnosis, nothing is known before.
    """
    ends = [check.answer(i) / EXIT for i in range(limits.cases)]
    finished = [float(json.loads(end.read_text())["seconds"]) for end in ends if end.exists()]
    left = limits.cases - len(finished)
    each = statistics.median(finished) if finished else math.nan if check.command else CASE
    workers = limits.workers or (0 if limits.cluster else min(device.cores(), AT_ONCE))
    end = "" if limits.seconds is None else f"; --minutes ends it after {duration(limits.seconds)}"
    if not (left and workers and math.isfinite(each)):
        return f"{count(left, 'case')} to do{end}"
    source = "as the finished ones" if finished else "recorded of one or two joints; of six, up to twenty times that"
    whole = duration(each * math.ceil(left / workers))
    return f"{count(left, 'case')} x {duration(each)} / {count(workers, 'worker')}: about {whole} ({source}){end}"


def run(check: Check, limits: Limits, say: Say, between: Between = lambda outcomes: None) -> list[Outcome]:
    """Make and diagnose cases up to a number or for a time; the outcomes of all that are finished.

    `between` gets the outcomes so far when a round of cases has been begun.

    Raises:
        UserError: what is wrong with model, logs, effects or cluster; a seal that is broken.
    """
    check.begin()
    say("measuring the robot's motion", 0, 1)
    own = bench(check)
    groups, unknown = own.groups(check.effects), own.unknown()
    end = None if limits.seconds is None else time.time() + limits.seconds
    with pool.executor(limits.cluster, limits.workers, AT_ONCE, check.folder) as calls:
        terms = Terms(end, process.apart(), bool(limits.cluster))
        crew = _Crew(calls, check, terms, limits.cases, say)
        for indices in rounds(limits.cases):
            if not crew.until(range(known(indices))):
                break
            so_far = outcomes(check, range(indices.start), own)
            before = trials([o for o in so_far if o.truth["index"] < known(indices)])
            todo = [i for i in plan(indices, groups, unknown, before, check.seed) if i.index not in crew.done]
            crew.begin(todo)
            if todo and before:
                between(so_far)
        crew.until(range(limits.cases))
    return outcomes(check, range(limits.cases), own)


class _Crew:
    """Cases under way; `done`: indices of those that are finished."""

    def __init__(self, calls: Executor, check: Check, terms: Terms, cases: int, say: Say) -> None:
        self.check, self.terms, self.running = check, terms, set[Future[int | None]]()
        self.done = {i for i in range(cases) if (check.answer(i) / EXIT).exists()}
        self._calls, self._cases, self._say = calls, cases, say

    def begin(self, items: Iterable[Item]) -> None:
        """Have these done, in their order."""
        self.running |= {self._calls.submit(work, self.check.anywhere(), self.terms, item) for item in items}
        self._say("cases", len(self.done), self._cases)

    def until(self, indices: range) -> bool:
        """Whether these cases, of those that were begun, were finished before the time was over.

        Raises:
            UserError: what is wrong with the robot, the entry or the cluster.
        """
        while self.running and not self.done.issuperset(indices):
            ended, self.running = wait(self.running, return_when=FIRST_COMPLETED)
            for index in (future.result() for future in ended):
                if index is not None:
                    _seen(self.check.answer(index) / EXIT)
                    self.done.add(index)
            self._say("cases", len(self.done), self._cases)
        return self.done.issuperset(indices)


def _seen(path: Path) -> None:
    """Wait until this machine sees a file that another one has written."""
    end = time.monotonic() + SEEN
    while not path.exists():
        if time.monotonic() > end:
            raise UserError(f"{path}: a worker wrote it, and it is not here; allowed: an --out that all machines share")
        time.sleep(0.1)


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
