"""Race tables of benchmark cases, on which rules of decision can be compared in milliseconds.

    python benchmarks/diagnosis/record.py run CASES --workers 8 [--gpu 4] [--seconds 500]   # CASE/record/table.json.gz
    python benchmarks/diagnosis/record.py one CASE                                          # one case in this process
    python benchmarks/diagnosis/record.py score CASES [--criteria same=.3 far=2]

A record holds every model that the race and the beam search visited with its held-out costs, what each of the two
named, and what either took. Cases come from `diagnosis/blind.py generate`; those below seed 2000 are for development.
"""

import argparse
import dataclasses
import gzip
import json
import os
import queue
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

RECORD = "record"


def work(case: Path, arguments: list[str]) -> None:
    """One case: today's diagnosis, then the one decision from the same single fits."""
    import worker

    from bayessim_mjx import diagnose as command
    from bayessim_mjx.diagnosis import run

    worker.without_pictures()
    marks: list[tuple[str, float, float, int]] = []
    kept: dict[str, Any] = {}

    def mark(name: str, race: Any = None) -> None:
        rollouts = race.fitter.simulator.rollouts if race is not None else 0
        marks.append((name, time.perf_counter(), time.process_time(), rollouts))

    original = run.investigate

    def watched(*args: Any, **options: Any) -> Any:
        stages = iter(("base", "singles", "pairs"))

        def keep(setup: Any, race: Any) -> None:
            name = next(stages, "more") if race is not None else "setup"
            mark(name, race)
            if name in ("base", "singles"):
                kept["snapshot"] = snapshot(race)

        def selected(*given: Any) -> Any:
            outcome = select(*given)
            mark("verdict", outcome)
            return outcome

        select, run.outcome.select = run.outcome.select, selected
        kept["asked"] = (args, options)
        kept["found"] = original(*args, **options | {"keep": keep})
        run.outcome.select = select
        return kept["found"]

    run.investigate = watched
    out = case / RECORD
    out.mkdir(exist_ok=True)
    given = ["--model", case / "model.xml", "--data", case / "logs", "--out", out, "--seed", "0", "--headless"]
    code = command.main([str(a) for a in [*given, *arguments]])
    run.investigate = original
    if "found" in kept:
        mark("rest", kept["found"].outcome)
        record = decided(kept, mark) | {"code": code, "marks": marks}
        said = json.loads((out / "diagnosis.json").read_text())
        if record["new"] != sorted(record["old"]):
            said = concluded(kept)
        named = {e["name"] + "@" + e["where"]: e for e in said["effects"]}
        for label, rivals in record["rivals"].items():
            if label in named:
                named[label]["equivalent_to"] = rivals
        (out / "new.json").write_text(json.dumps(said, default=float))
        with gzip.open(out / "table.part", "wt") as file:
            json.dump(record, file, default=float)
        (out / "table.part").rename(out / "table.json.gz")


def snapshot(race: Any) -> Any:
    """The race as it is now."""
    base = race.models[frozenset()]
    own = {"models": dict(race.models), "screened": list(race.screened), "candidates": list(race.candidates)}
    return dataclasses.replace(race, base=base, winner=base, **own)


def decided(kept: dict[str, Any], mark: Any) -> dict[str, Any]:
    """What one decision makes of the race's single fits, and the tables of all that either visited."""
    from bayessim_mjx.diagnosis.selection import chosen
    from bayessim_mjx.diagnosis.selection.criteria import Criteria
    from bayessim_mjx.diagnosis.selection.fits import Fits

    found, race = kept["found"], kept["snapshot"]
    before = race.fitter.simulator.rollouts
    ruling, selection = chosen.ruled(race, Criteria(), lambda *_: None)
    mark("decision", race)
    kept["ruled"] = (race, ruling)
    return {
        "old": [e.label for e in found.model.effects],
        "new": sorted(selection.answer),
        "rivals": {label: [r.to_dict() for r in rivals] for label, rivals in ruling.rivals.items()},
        "trace": selection.trace,
        "rollouts": race.fitter.simulator.rollouts - before,
        "visited": selection.table.to_dict(),
        "raced": Fits(found.outcome.reopened(), lambda *_: None).table.to_dict()["rows"],
    }


def concluded(kept: dict[str, Any]) -> dict[str, Any]:
    """The diagnosis that follows from the one decision: how far, what remains, the verdict."""
    from bayessim_mjx.diagnosis import run
    from bayessim_mjx.diagnosis.selection.criteria import Criteria
    from bayessim_mjx.diagnosis.summary import assemble

    args, options = kept["asked"]
    run.prepare = lambda *_, **__: kept["found"].setup
    run.outcome.chosen.run = lambda *_: kept["ruled"]
    found = run.investigate(*args, **options | {"criteria": Criteria(), "keep": None, "verdict": None})
    return assemble.diagnosis_of(found).to_dict()


def run_all(args: argparse.Namespace) -> None:
    """Every case without a record, each in a process of its own, until the time is over."""
    every = sorted(
        (p.parent for p in args.cases.glob("*/truth.json")), key=lambda f: (f.name.rpartition("_s")[2], f.name)
    )
    every = [f for f in every if not (f / RECORD / "table.json.gz").exists()]
    small: queue.Queue[Path] = queue.Queue()
    large: queue.Queue[Path] = queue.Queue()
    for folder in every:
        (small if folder.name.startswith(tuple(args.on_cpu.split(","))) else large).put(folder)
    until = time.monotonic() + args.seconds
    with ThreadPoolExecutor(args.workers + args.gpu) as pool:
        for i in range(args.workers + args.gpu):
            own = (small, large) if i < args.workers else (large, small)
            pool.submit(_drain, own, "cpu" if i < args.workers else "gpu", i, until, args.more)


def _drain(
    queues: tuple[queue.Queue[Path], queue.Queue[Path]], device: str, core: int, until: float, more: list[str]
) -> None:
    quiet = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
    own = {"JAX_PLATFORMS": "cpu"} if device == "cpu" else {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    for waiting in queues:
        while time.monotonic() < until:
            try:
                folder = waiting.get_nowait()
            except queue.Empty:
                break
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
            print(f"{folder.name}: {device} exit {code}, {time.monotonic() - started:.0f} s", flush=True)


def redecided(case: Path, given: list[str]) -> dict[str, Any]:
    """What a decision with other criteria names on the table of a case, before finalists are simulated."""
    from bayessim_mjx.diagnosis.selection import decide, table
    from bayessim_mjx.diagnosis.selection.criteria import Criteria

    record = json.loads(gzip.decompress((case / RECORD / "table.json.gz").read_bytes()))
    known = table.read(record["visited"])
    found = decide.decide(known, decide.order(known.laws), Criteria().changed(given))
    laws = [known.laws[label] for label in sorted(found.answer)]
    rivals = [{"effects": sorted(r.key - found.answer)} for r in found.rivals]
    verdict = json.loads((case / RECORD / "new.json").read_text())["verdict"]
    effects = [{"name": c.effect, "where": c.where, "parameters": {}, "equivalent_to": rivals} for c in laws]
    return {"verdict": verdict if not laws or verdict == "unexplained" else "effects", "effects": effects}


def score(args: argparse.Namespace) -> None:
    """Rates of both rules on the same cases, and what they took."""
    import blind
    import numpy as np
    from score import rates
    from score import read as outcome_of

    done = [f for f in blind.cases(args.cases) if (f / RECORD / "new.json").exists()]
    said = {
        "rules of the race": [json.loads((f / RECORD / "diagnosis.json").read_text()) for f in done],
        "one decision": [json.loads((f / RECORD / "new.json").read_text()) for f in done],
        "one decision, again on the tables (names alone)": [redecided(f, args.criteria) for f in done],
    }
    for name, told in said.items():
        outcomes = [dataclasses.replace(outcome_of(f, RECORD), said=one) for f, one in zip(done, told, strict=True)]
        print(f"{name}: {len(outcomes)} cases")
        for rate in rates(outcomes):
            if rate.answers:
                print(f"  {rate.what}: {sum(rate.answers)} of {len(rate.answers)}")
    took = []
    for f in done:
        record = json.loads(gzip.decompress((f / RECORD / "table.json.gz").read_bytes()))
        at = {m[0]: m for m in record["marks"]}
        if "singles" in at:
            took.append([at["verdict"][i] - at["singles"][i] for i in (2, 3)])
            took[-1] += [at["decision"][i] - at["rest"][i] for i in (2, 3)]
    if took:
        cpu, rollouts, new_cpu, new_rollouts = np.sum(took, 0)
        print(f"after the single effects, {len(took)} cases: rules {cpu:.0f} CPU s, {rollouts:.0f} rollouts;", end=" ")
        print(f"one decision {new_cpu:.0f} CPU s, {new_rollouts:.0f} rollouts")


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
    told = commands.add_parser("score")
    told.add_argument("cases", type=Path)
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
        os.sched_setaffinity(0, {args.core})  # before JAX counts the cores
    work(args.case, args.more)


if __name__ == "__main__":
    main()
