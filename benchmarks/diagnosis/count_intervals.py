"""Do 90 % intervals hold where a data sheet is less accurate than assumed, and on few or poor logs?

    python benchmarks/diagnosis/count_intervals.py run OUT --workers 64 --minutes 9 [--only sheets] [--shard 0/2]
    python benchmarks/diagnosis/count_intervals.py isolable OUT --workers 64 --minutes 9   # needs no result
    python benchmarks/diagnosis/count_intervals.py keep OUT                               # what was found, for `score`
    python benchmarks/diagnosis/count_intervals.py score OUT [--before OTHER]

`counted_cases.py` fixes the cases: 150 of data sheets, 60 of poor logs, 90 outside the library, and 60 in each of two
other realities. Rules, fixed before any case was diagnosed:

- **Command.** `diagnose --model --data --seed 0 --verdict_only`: nothing is said of the data sheet's accuracy, all
  effects are on offer, no time limit of the search. Another commit (that has `bayessim_mjx.pool`) is measured with
  PYTHONPATH set to its checkout, another rule with `--more`.
- **Running.** A process on one core for each case; it makes the case, diagnoses it and writes OUT/CASE/result.json.
  Those that are likely to take longest begin first. When the minutes are over, running ones are killed. A case without
  result counts as unfinished. The next `run` begins it again; its logs and the fits of its search stay.
- **Names.** A single is right if its effect is named at its place; exactly, if nothing else is. It is inside if the
  effect is in the answer as a set: named, told as equivalent, as hidden beside it, or as the work of a known parameter
  that is far from the data sheet (`same_as`; since 965c005). Of a double both have to be.
  A false name is one that is not hidden. A verdict that names nothing, or a command that fails, names nothing.
  Cases in which a hidden effect is weaker than 80 % of what was asked for are left out of these rates, and counted.
  The size of a set is the number of its effect@place, mean over the answers that name something.
- **Isolable** is a case if, by its truth alone, every other cause of the generator leaves something of each hidden
  effect, and known parameters do that are free within 90 % of their nominal values (`lookalikes.py`; no accuracy is
  stated). An effect that is a known parameter by another name (viscous friction, armature) never is. One process
  examines one case into OUT/CASE/isolable.json; `keep` adds them to isolable.json here, which `score` reads.
- **Strengths.** Parameters of rightly named effects, where they mean the same in reality and library (not those of base
  flexibility, external force and load friction). An interval is mean +- 1.645 sd. A parameter at a bound or without sd
  is a miss, unless it says "at least" or "at most" and that holds.
- **Known parameters.** Every mass, damping and armature, in cases whose names are exactly the hidden ones; beside it
  those of all other answers. One without sd is a miss; those of which nothing is said are counted apart.
- **Closed share.** `gap.closed.ci` against what the same model closes on fresh motions of the same runs (`fresh.py`).
  Answers that name effects but state no interval (one condition) are counted apart.
- **Outside.** Of a null an alarm is an effect that is named, or "unexplained"; a cause that the library does not have
  is found if the verdict is "unexplained"; it is taken for an effect if the verdict names one.
- **Realities.** A table of its own has one row for each. All other tables are of the cases that MuJoCo C simulates.
- **Stated probabilities.** That of the answer (`evidence` of diagnosis.json), against whether it is the hidden set
  (nothing, of a null), what is one with it (`hidden`, `same_as`) included; unknown causes left out. Brier score, and
  bins of a fifth.
- **Goal.** 86 to 94 % of each; intervals beside the rates are 95 % Wilson intervals. Parameters of one case are not
  independent of each other: those of strengths and known parameters are too narrow.
"""

import argparse
import dataclasses
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any

from bayessim_mjx import pool

RESULT, PLAN, RIVALS = "result.json", "plan.json", "isolable.json"
# CPU seconds of one single with an empty compilation cache (machine C; the servo arm's was not ended), for the order
# alone; a double is taken to last twice as long
SECONDS = {"pendulum": 67, "cartpole": 109, "two_link": 141, "leg": 187, "arm_servo": 450, "arm_torque": 282}
REALITIES = ("mujoco", "own laws", "own integrator")
DONE, ONE = {"run": RESULT, "isolable": RIVALS}, {"run": "one", "isolable": "rivals"}
THREADS = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
ALONE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def one(folder: Path, more: list[str]) -> None:
    """Make a case unless it is there, diagnose it, write its result."""
    import worker
    from counted_cases import again, make, seed_of

    worker.without_pictures()
    plan = _plan_of(folder)
    result: dict[str, Any] = {"plan": dataclasses.asdict(plan)}
    try:
        if not (folder / "truth.json").exists():
            make(plan, folder)
        truth = result["truth"] = json.loads((folder / "truth.json").read_text())
        result["joints"] = worker.joints_of(folder)
        result["making"] = time.process_time()
        out = folder / "diagnosis"
        words = ["--model", folder / "model.xml", "--data", folder / "logs", "--out", out, "--seed", "0", "--headless"]
        result["code"], seconds, found = worker.watched([*map(str, words), "--verdict_only", *more])
        result |= seconds | {"cpu": time.process_time() - result["making"]}
        if (out / "diagnosis.json").exists():
            result["said"] = json.loads((out / "diagnosis.json").read_text())
            result["said"].pop("candidates", None)
        result["closed"] = None if found is None else _closed(found, again(plan, truth), seed_of(plan.kind, plan.seed))
    except Exception:
        result["error"] = traceback.format_exc()
    result["all_cpu"] = time.process_time()
    _write(folder / RESULT, result)


def rivals(folder: Path) -> None:
    """Which other causes explain the same motion as the hidden effects of a case."""
    from counted_cases import rivals_of

    truth = None
    if (folder / RESULT).exists():
        truth = json.loads((folder / RESULT).read_text()).get("truth")
    _write(folder / RIVALS, rivals_of(_plan_of(folder), truth))


def _plan_of(folder: Path) -> Any:
    """The case that `_waiting` wrote into its folder."""
    from counted_cases import Plan

    given = json.loads((folder / PLAN).read_text())
    return Plan(**given | {"effects": tuple(given["effects"])})


def _closed(found: Any, case: Any, seed: int) -> float | None:
    import fresh

    return fresh.closed(found, case.robot, case.plant(), seed)


def _write(path: Path, content: Any) -> None:
    from bayessim_mjx import atomic

    atomic.write_text(path, json.dumps(content, default=float))


def run(args: argparse.Namespace) -> None:
    """All cases without a result, longest first, until the minutes are over."""
    waiting, end = _waiting(args), time.time() + 60 * args.minutes
    print(f"{len(waiting)} cases, {args.minutes:g} minutes", flush=True)
    with pool.executor(args.cluster, args.workers, share=False) as calls:

        def begin(folder: Path) -> Future[int | None]:
            output = folder / ("output.txt" if args.does == "run" else "rivals.txt")
            # of one case, somebody else shares the cores among such commands
            return calls.submit(pool.alone, _words(folder, args), output, end, variables(args.platforms), not args.case)

        side_by_side(waiting, begin, lambda f: _line(f, args.does))


def side_by_side(
    waiting: list[Path],
    begin: Callable[[Path], Future[int | None]],
    line: Callable[[Path], str],
    ready: Callable[[Path], bool] = lambda folder: True,
) -> None:
    """A command for each folder, as `pool.alone` ends it when the time is over.

    Args:
        line: what is printed when one has ended; ready: whether one may begin. It ends if none may and none runs.
    """
    running, killed, late = dict[Future[int | None], Path](), 0, 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that processes end with it
    while True:
        for folder in [f for f in waiting if ready(f)]:
            waiting.remove(folder)
            running[begin(folder)] = folder
        if not running:
            break
        for future in wait(running, return_when=FIRST_COMPLETED)[0]:
            folder, code = running.pop(future), future.result()
            killed, late = killed + (code == -signal.SIGKILL), late + (code is None)
            if code not in (None, -signal.SIGKILL):
                print(line(folder), flush=True)
    print(f"{killed} killed, {late + len(waiting)} not begun" if killed or late or waiting else "all ended")


def variables(platforms: str = "cpu") -> dict[str, str]:
    """Environment variables of a process of one thread."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {ALONE}".strip()
    return {"JAX_PLATFORMS": platforms, "XLA_FLAGS": flags, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | THREADS


def _waiting(args: argparse.Namespace) -> list[Path]:
    from counted_cases import frozen, plans

    index, count = (int(n) for n in args.shard.split("/"))
    chosen = [*frozen()] if args.only == "frozen" else [p for p in plans() if args.only in ("all", p.group)]
    chosen = [p for p in chosen if p.system in args.systems.split(",")] if args.systems else chosen
    chosen = [p for p in chosen if args.reality in ("all", p.reality) and args.case in ("", p.name)]
    if args.does == "isolable":
        chosen = [p for p in chosen if p.group != "outside"]
    chosen = sorted(chosen, key=lambda p: (-SECONDS[p.system] * max(len(p.effects), 1), p.seed, p.name))[index::count]
    folders = []
    for plan in chosen:
        folder = args.out.resolve() / plan.name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / PLAN).write_text(json.dumps(dataclasses.asdict(plan)))
        folders += [] if (folder / DONE[args.does]).exists() else [folder]
    return folders


def _words(folder: Path, args: argparse.Namespace) -> list[str]:
    return [sys.executable, str(Path(__file__).resolve()), ONE[args.does], str(folder.resolve()), f"--more={args.more}"]


def _line(folder: Path, does: str) -> str:
    if does == "isolable":
        found = json.loads((folder / RIVALS).read_text()) if (folder / RIVALS).exists() else []
        closest = [f"{f['left']:.2f}, {r['name']}@{r['where']} {r['left']:.2f}" for f in found for r in f["rivals"][:1]]
        return f"{folder.name}: {'; '.join(closest) or 'no result'}"
    if not (folder / RESULT).exists():
        return f"{folder.name}: no result"
    result = json.loads((folder / RESULT).read_text())
    said = result.get("said", {})
    named = ", ".join(f"{e['name']}@{e['where']}" for e in said.get("effects", []))
    hidden = ", ".join(f"{e['name']}@{e['where']}" for e in result.get("truth", {}).get("effects", []))
    failed = result.get("error", "").strip().splitlines()[-1:]
    return f"{folder.name}: {said.get('verdict', 'no result')} {named} (hidden: {hidden}) {''.join(failed)}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="does")
    for name, text in (("run", "cases without a result"), ("isolable", "rivals of the hidden effects, by the truth")):
        several = commands.add_parser(name, help=text)
        several.add_argument("out", type=Path)
        several.add_argument("--workers", type=int, help="cases at once, one core each (default: as many as cores)")
        several.add_argument("--cluster", **pool.CLUSTER)
        several.add_argument("--minutes", type=float, default=1e6, help="when they are over, running cases are killed")
        several.add_argument("--only", choices=("all", "sheets", "logs", "outside", "frozen"), default="all")
        several.add_argument("--systems", default="", help="some robots, separated by commas; default all")
        several.add_argument("--reality", choices=("all", *REALITIES), default="all", help="what simulates the cases")
        several.add_argument("--case", default="", help="one case by its name, on any core")
        several.add_argument("--platforms", default="cpu", help="JAX's; 'cuda,cpu': all cases share a GPU")
        several.add_argument("--shard", default="0/1", help="i/n: every n-th case, from the i-th")
        several.add_argument("--more", default="", help="further options of the command, as --more='--accuracy 5%%'")
    for name in ONE.values():
        single = commands.add_parser(name, help="one case in this process")
        single.add_argument("folder", type=Path)
        single.add_argument("--more", default="")
    commands.add_parser("keep", help="add what was found of rivals to isolable.json").add_argument("out", type=Path)
    table = commands.add_parser("score", help="tables of what came of all cases")
    table.add_argument("out", type=Path)
    table.add_argument("--before", type=Path, help="the same cases by another commit")
    return parser


def main() -> None:
    args = _parser().parse_args()
    if args.does in ONE:
        run(args)
    elif args.does == "keep":
        from counted_cases import keep

        print(f"{keep(args.out)} cases are examined")
    elif args.does == "score":
        from counted_tables import tables

        print(tables(args.out, args.before))
    else:
        one(args.folder, args.more.split()) if args.does == "one" else rivals(args.folder)


if __name__ == "__main__":
    main()
