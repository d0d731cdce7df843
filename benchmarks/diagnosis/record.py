"""Tables of all models that were tried on benchmark cases, on which criteria can be compared in milliseconds.

    python benchmarks/diagnosis/record.py run CASES --workers 8 [--gpu 4] [--seconds 500]   # CASE/record/table.json.gz
    python benchmarks/diagnosis/record.py one CASE                                          # one case in this process
    python benchmarks/diagnosis/record.py score CASES [--left-out SINGLES] [--criteria same=.3 far=2]

A record holds every model that the search visited with its held-out costs, the finalists' costs as simulated, what was
named, and what it took. Cases come from `diagnosis/blind.py generate`; those below seed 2000 are for development.
"""

import argparse
import dataclasses
import gzip
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from cases import ACCURACY, KNOWN
from families import without

RECORD = "record"
STAGES = ("setup", "base", "singles", "choice")


def stage(tried: Any) -> str:
    """How far a search has come that keeps what it knows after every batch of fits; the last of a stage is its end."""
    return STAGES[0] if tried is None else STAGES[1 + min(max(map(len, tried.models), default=0), 2)]


def work(case: Path, arguments: list[str]) -> None:
    """One case: the diagnosis as the command makes it, and the tables that its choice rests on."""
    import worker

    from bayessim_mjx import diagnose as command
    from bayessim_mjx.diagnosis import run

    worker.without_pictures()
    marks: list[tuple[str, float, float, int, float]] = []
    kept: dict[str, Any] = {}
    compiling = worker.compilations()

    def mark(name: str, tried: Any = None) -> None:
        rollouts = tried.fitter.simulator.rollouts if tried is not None else 0
        marks.append((name, time.perf_counter(), time.process_time(), rollouts, worker.covered(compiling)))

    original = run.investigate

    def watched(*args: Any, **options: Any) -> Any:
        keep = lambda setup, tried: mark(stage(tried), tried)  # noqa: E731
        kept["found"] = original(*args, **options | {"keep": keep})
        return kept["found"]

    run.investigate = watched
    out = case / RECORD
    out.mkdir(exist_ok=True)
    given = ["--model", case / "model.xml", "--data", case / "logs", "--out", out, "--seed", "0", "--headless"]
    given += ["--accuracy", ACCURACY]
    code = command.main([str(a) for a in [*given, *arguments]])
    run.investigate = original
    if "found" in kept:
        selection = kept["found"].selection
        mark("rest", selection)
        record = {"code": code, "marks": marks, "named": [e.label for e in selection.answer.effects]}
        record |= {
            "trace": selection.trace,
            "rivals": {k: [r.to_dict() for r in v] for k, v in selection.rivals.items()},
        }
        record |= {"searched": selection.searched.to_dict(), "finalists": selection.table.to_dict()}
        with gzip.open(out / "table.part", "wt") as file:
            json.dump(record, file, default=float)
        (out / "table.part").rename(out / "table.json.gz")


def run_all(args: argparse.Namespace) -> None:
    """Every case without a record, each in a process of its own, until the time is over; new ones are taken up too."""
    until = time.monotonic() + args.seconds
    waiting = Waiting([args.cases, *filter(None, [args.left_out])], tuple(args.on_cpu.split(",")))
    with ThreadPoolExecutor(args.workers + args.gpu) as pool:
        for i in range(args.workers + args.gpu):
            pool.submit(_drain, waiting, i, i < args.workers, args, until)


class Waiting:
    """Cases that nobody began, by seed and name: all systems and kinds are tried equally often."""

    def __init__(self, folders: Sequence[Path], small: tuple[str, ...]) -> None:
        self.folders, self.small, self.begun, self.lock = folders, small, set[Path](), threading.Lock()

    def take(self, small: bool) -> Path | None:
        """The next case, for a worker on a core (`small`) preferably one of the small systems."""
        with self.lock:
            every = [p.parent for folder in self.folders for p in folder.glob("*/truth.json")]
            every = [f for f in every if f not in self.begun and not (f / RECORD / "table.json.gz").exists()]
            turn = lambda f: (f.name.startswith(self.small) != small, f.name.rpartition("_s")[2], f.name)  # noqa: E731
            found = min(every, key=turn, default=None)
            if found is not None:
                self.begun.add(found)
            return found


def _drain(waiting: Waiting, core: int, small: bool, args: argparse.Namespace, until: float) -> None:
    quiet = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    card = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "CUDA_VISIBLE_DEVICES": str(core % args.cards)}
    own = {"JAX_PLATFORMS": "cpu"} if small else card
    while time.monotonic() < until and (folder := waiting.take(small)) is not None:
        more = args.more
        if folder.parent == args.left_out:
            effects = json.loads((folder / "truth.json").read_text())["effects"]
            more = ["--effects", without((e["name"] for e in effects), KNOWN), *more]
        (folder / RECORD).mkdir(exist_ok=True)
        started = time.monotonic()
        command = [sys.executable, __file__, "one", str(folder), "--core", str(core), "--more", *more]
        with (folder / RECORD / "output.txt").open("w") as text:
            try:
                code = subprocess.run(
                    command, stdout=text, stderr=subprocess.STDOUT, env=os.environ | quiet | own,
                    timeout=max(until - time.monotonic(), 1.0),
                ).returncode  # fmt: skip
            except subprocess.TimeoutExpired:
                code = 124
        took = f"{time.monotonic() - started:.0f} s"
        print(f"{folder.name}: {'cpu' if small else 'gpu'} exit {code}, {took}", flush=True)


def redecided(case: Path, given: list[str]) -> dict[str, Any]:
    """What other criteria name on the tables of a case: among its finalists, or before any are simulated.

    The latter where they would have others.
    """
    from bayessim_mjx.diagnosis.selection import beam, decide, table
    from bayessim_mjx.diagnosis.selection.criteria import Criteria

    record = recorded(case)
    known, seen, criteria = table.read(record["searched"]), table.read(record["finalists"]), Criteria().changed(given)
    less = decide.order(known.laws)
    found = decide.decide(known, less, criteria)
    if set(beam.finalists(found, criteria.finalists)) <= seen.rows.keys():
        found = decide.decide(seen, less, criteria)
    laws = [known.laws[label] for label in sorted(found.answer)]
    rivals = [{"effects": sorted(r.key - found.answer)} for r in found.rivals]
    verdict = json.loads((case / RECORD / "diagnosis.json").read_text())["verdict"]
    effects = [{"name": c.effect, "where": c.where, "parameters": {}, "equivalent_to": rivals} for c in laws]
    return {"verdict": verdict if not laws or verdict == "unexplained" else "effects", "effects": effects}


def recorded(case: Path) -> dict[str, Any]:
    return dict(json.loads(gzip.decompress((case / RECORD / "table.json.gz").read_bytes())))


def score(args: argparse.Namespace) -> None:
    """Rates as diagnosed and with other criteria, cases that one alone has right, and what the choice took."""
    import blind
    from score import mcnemar, rates, wilson
    from score import read as outcome_of

    folders = [args.cases, *filter(None, [args.left_out])]
    every = [[f for f in blind.cases(folder) if (f / RECORD).exists()] for folder in folders]
    done = [[f for f in some if (f / RECORD / "table.json.gz").exists()] for some in every]
    print(f"{sum(map(len, done))} cases ended, {sum(map(len, every)) - sum(map(len, done))} did not")
    told = {}
    for name, said in (
        ("as diagnosed", lambda f: json.loads((f / RECORD / "diagnosis.json").read_text())),
        (f"again on the tables, criteria {' '.join(args.criteria) or 'unchanged'} (names alone)",
         lambda f: redecided(f, args.criteria)),
    ):  # fmt: skip
        told[name] = rates(*([dataclasses.replace(outcome_of(f, RECORD), said=said(f)) for f in some] for some in done))
        print(name)
        for rate in told[name]:
            low, high = wilson(sum(rate.answers), len(rate.answers))
            counted = f"{sum(rate.answers)} of {len(rate.answers)} ({low:.2f} to {high:.2f})"
            print(f"  {rate.told}: {counted if rate.answers else 'not counted'}")
    print("right by one of the two alone: as diagnosed, again, p of McNemar's exact test")
    for a, b in zip(*told.values(), strict=True):
        if a.answers and len(a.answers) == len(b.answers):
            pairs = list(zip(a.answers, b.answers, strict=True))
            only = [sum(x > y for x, y in pairs), sum(x < y for x, y in pairs)]
            print(f"  {a.what}: {only[0]}, {only[1]}, {mcnemar(*only):.2f}")
    costs([f for some in done for f in some])


def costs(done: Sequence[Path]) -> None:
    """What the diagnoses took up to the single effects, and from there to the model that they name."""
    import numpy as np

    took: dict[str, list[list[float]]] = {}
    for f in done:
        at = {m[0]: m for m in recorded(f)["marks"]}
        for before, name in zip(STAGES, STAGES[1:], strict=False):  # a stage that was not needed took nothing
            at.setdefault(name, at.get(before))
        if at["choice"] is not None:
            spent = [
                at[end][i] - at[begin][i] for begin, end in zip(STAGES, STAGES[1:], strict=False) for i in (2, 4, 3)
            ]
            took.setdefault(f.name.rsplit("_", 2)[0], []).append(spent[3:])
    for name, each in [*took.items(), ("all", [x for some in took.values() for x in some])]:
        if each:
            a, c, r, a2, c2, r2 = np.sum(each, 0)
            print(
                f"{name}, {len(each)} cases: single effects {a:.0f} CPU s ({c:.0f} s compiling), {r:.0f} rollouts;"
                f" choice {a2:.0f} CPU s ({c2:.0f} s compiling), {r2:.0f} rollouts"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="does")
    several = commands.add_parser("run")
    several.add_argument("cases", type=Path)
    several.add_argument("--workers", type=int, default=1, help="processes on a core each")
    several.add_argument("--gpu", type=int, default=0, help="processes on the GPU")
    several.add_argument(
        "--on-cpu", default="pendulum,cartpole,two_link", help="systems that a core each is enough for"
    )
    several.add_argument("--seconds", type=float, default=1e9)
    several.add_argument("--cards", type=int, default=1, help="GPUs that those processes take turns on")
    several.add_argument("--left-out", type=Path, help="folder of singles, diagnosed without the effect's family")
    told = commands.add_parser("score")
    told.add_argument("cases", type=Path)
    told.add_argument("--left-out", type=Path, help="folder of singles that were diagnosed without the effect's family")
    told.add_argument("--criteria", nargs="*", default=[], help="key=value, for the decision on the tables")
    single = commands.add_parser("one")
    single.add_argument("case", type=Path)
    single.add_argument("--core", type=int)
    for each in (several, single):
        each.add_argument("--more", nargs=argparse.REMAINDER, default=[], help="further arguments of the command; last")
    args = parser.parse_args()
    if args.does == "run":
        run_all(args)
        return
    if args.does == "score":
        score(args)
        return
    if args.core is not None and hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {allowed[args.core % len(allowed)]})  # before JAX counts the cores
    work(args.case, args.more)


if __name__ == "__main__":
    main()
