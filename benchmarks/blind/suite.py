"""The blind suite: robots, sealed cases of every kind, entries that read a folder and write diagnosis.json, one scorer.

    python benchmarks/blind/suite.py generate --out SUITE                  # development seeds
    python benchmarks/blind/suite.py enter SUITE --entry ours "naive BIC"  # or --name MINE --command WORDS
    python benchmarks/blind/suite.py leaderboard SUITE                     # opens the seals; a table

An entry gets one case at a time, in a folder with model.xml and logs/ alone, and has to write {out}/diagnosis.json
(docs/blind.md). Seeds below 2000 are for development. Those that count are drawn by release.py, once per release.
"""

import argparse
import json
import shlex
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "diagnosis"))
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from kinds import KINDS, VERSION, make  # noqa: E402
from systems import SYSTEMS  # noqa: E402

from bayessim_mjx import atomic, pool  # noqa: E402
from bayessim_mjx.blind import process, seal  # noqa: E402
from bayessim_mjx.blind.outcome import Outcome, alarm, covered, label, rate  # noqa: E402
from bayessim_mjx.blind.worker import EXIT  # noqa: E402

COUNTED = 2000  # seeds from here on count
ENTRIES = {
    "ours": "{python} -m bayessim_mjx.diagnose --model {model} --data {data} --out {out} --accuracy 5% --headless "
    "--verdict_only",
    "parameter refit (mujoco.sysid)": "{python} {here}/entries/refit.py {model} {data} {out}",
    "naive BIC": "{python} {here}/entries/bic.py {model} {data} {out}",
    "sparse regression (SINDy)": "{python} {here}/entries/sindy.py {model} {data} {out}",
    "classifier": "{python} {here}/entries/classifier.py {model} {data} {out}",
    "black-box residual": "{python} {here}/entries/residual.py {model} {data} {out}",
}
MEASURES = ("single", "in the set", "weak", "double", "false alarms", "of coloured noise", "unknown", "coverage")


def generate(out: Path, seeds: range, systems: list[str], kinds: list[str]) -> None:
    """Write cases that are not there yet."""
    atomic.write_text(_made(out) / "suite.json", json.dumps({"version": VERSION, "seeds": [seeds.start, seeds.stop]}))
    for seed in seeds:
        for name in systems:
            for kind in kinds:
                started = time.perf_counter()
                if make(SYSTEMS[name], kind, seed, out):
                    print(f"{name}_{kind}_{seed}: {time.perf_counter() - started:.0f} s", flush=True)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def cases(suite: Path) -> list[Path]:
    return sorted(p.parent for p in suite.glob("cases/*/seal.txt"))


def enter(suite: Path, name: str, command: str, workers: int | None, timeout: float, cluster: str = "") -> None:
    """Have every case diagnosed that this entry has not finished."""
    suite = suite.resolve()  # for processes in other folders
    one = partial(_one, suite, name=name, command=command, timeout=timeout, remote=bool(cluster))
    with pool.executor(cluster, workers) as calls:
        for line in calls.map(one, unfinished(suite, name)):
            print(line, flush=True)


def _one(suite: Path, case: Path, name: str, command: str, timeout: float, remote: bool) -> str:
    answer = _made(suite / "entries" / name / case.name)
    with tempfile.TemporaryDirectory(prefix="blind_") as folder:
        work = Path(folder)
        shutil.copytree(case / "given", work, dirs_exist_ok=True)
        where = {"model": work / "model.xml", "data": work / "logs", "out": work / "out"}
        words = [w.format(python=sys.executable, here=HERE.resolve(), **where) for w in shlex.split(command)]
        with (answer / "output.txt").open("w") as text:
            ended = process.run(words, work, text, timeout, suite / "sealed", remote)
        if (said := work / "out" / "diagnosis.json").exists():
            shutil.copy(said, answer / "diagnosis.json")
    if ended.code in process.STOPPED:
        return f"{case.name}: stopped"
    atomic.write_text(answer / EXIT, json.dumps(vars(ended) | {"seal": (case / "seal.txt").read_text()}))
    return f"{name}, {case.name}: exit {ended.code}, {ended.cpu:.0f} s of CPU, {ended.seconds:.0f} s"


def unfinished(suite: Path, name: str) -> list[Path]:
    """Cases that an entry has not finished."""
    return [c for c in cases(suite) if not (suite / "entries" / name / c.name / EXIT).exists()]


def outcomes(suite: Path, name: str) -> list[Outcome]:
    """What an entry said of the cases it has finished, their seals opened."""
    found = []
    for case in cases(suite):
        answer = suite / "entries" / name / case.name
        if not (answer / EXIT).exists():
            continue
        ended = json.loads((answer / EXIT).read_text())
        seals = {str(case / "seal.txt"): (case / "seal.txt").read_text(), str(answer / EXIT): ended["seal"]}
        truth = seal.opened(case / "given", suite / "sealed" / f"{case.name}.json", seals)
        model = mujoco.MjModel.from_xml_path(str(case / "given" / "model.xml"))
        drives = {model.actuator(i).name: model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)}
        said = answer / "diagnosis.json"
        told = json.loads(said.read_text()) if said.exists() else None
        found.append(Outcome(case, truth, told, drives, ended["seconds"], ended.get("cpu", np.nan)))
    return found


def measures(found: list[Outcome]) -> dict[str, dict[str, float]]:
    """{measure: rate}: a case without a result is a miss; it is no alarm."""
    of = lambda *kinds: [o for o in found if o.kind in kinds]  # noqa: E731
    right = lambda o: all(o.right(e) for e in o.truth["effects"])  # noqa: E731
    inside = lambda o: all(o.inside(e) for e in o.truth["effects"])  # noqa: E731
    return {
        "single": rate([right(o) for o in of("single")]),
        "in the set": rate([inside(o) for o in of("single")]),
        "weak": rate([right(o) for o in of("weak")]),
        "double": rate([right(o) for o in of("double")]),
        "false alarms": rate([alarm(o) for o in of("null")]),
        "of coloured noise": rate([alarm(o) for o in of("coloured")]),
        "unknown": rate([label(o) == "unexplained" for o in of("unknown")]),
        "coverage": rate([c for o in of("single", "weak", "double") for c in covered(o)]),
    }


def cost(found: list[Outcome]) -> dict[str, float]:
    """{robot: mean s of CPU of a case}."""
    robots = sorted({str(o.truth["robot"]) for o in found})
    return {r: float(np.mean([o.cpu for o in found if o.truth["robot"] == r])) for r in robots}


def table(suite: Path) -> tuple[str, dict]:
    """(Markdown, {entry: {measure: rate, "cases", "cpu": {robot: s}}}) of all entries, the best at singles first."""
    names = sorted(p.name for p in (suite / "entries").glob("*") if p.is_dir())
    figures: dict[str, dict] = {}
    for name in names:
        if found := outcomes(suite, name):
            figures[name] = measures(found) | {"cases": len(found), "cpu": cost(found)}
    share = lambda m: m["hits"] / m["n"] if m["n"] else -1.0  # noqa: E731
    rows = ["| entry | " + " | ".join(MEASURES) + " | cases | CPU s |", "|---" * (len(MEASURES) + 3) + "|"]
    for name, own in sorted(figures.items(), key=lambda f: -share(f[1]["single"])):
        told = [f"{own[m]['hits']}/{own[m]['n']}" if own[m]["n"] else "-" for m in MEASURES]
        cpu = np.mean(list(own["cpu"].values()))
        rows.append(f"| {name} | " + " | ".join(told) + f" | {own['cases']} | {cpu:.0f} |")
    return "\n".join(rows), figures


def seeds_of(args: argparse.Namespace) -> range:
    first, last = (int(n) for n in args.seeds.split(":"))
    if last > COUNTED and not args.count:
        sys.exit(f"--seeds {args.seeds}: seeds from {COUNTED} on count; leave them to release.py")
    return range(first, last)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="does")
    new = commands.add_parser("generate", help="write sealed cases")
    new.add_argument("--out", type=Path, required=True)
    new.add_argument("--seeds", default="1000:1003", help="first:last, last not included")
    new.add_argument("--systems", default="pendulum,two_link", help=f"of {', '.join(SYSTEMS)}")
    new.add_argument("--kinds", default=",".join(KINDS))
    new.add_argument("--count", action="store_true", help="seeds that count, for release.py")
    run = commands.add_parser("enter", help="have the cases diagnosed")
    run.add_argument("suite", type=Path)
    run.add_argument("--entry", nargs="*", default=[], help=f"of {', '.join(ENTRIES)}")
    run.add_argument("--name", help="of an entry of your own")
    run.add_argument("--command", help="its command, with {model}, {data} and {out}")
    run.add_argument("--workers", type=int, help="cases at a time (default: as many as cores)")
    run.add_argument("--cluster", **pool.CLUSTER)
    run.add_argument("--timeout", type=float, default=3600.0, help="s per case")
    told = commands.add_parser("leaderboard", help="open the seals and score all entries")
    told.add_argument("suite", type=Path)
    args = parser.parse_args()
    if args.does == "generate":
        generate(args.out, seeds_of(args), args.systems.split(","), args.kinds.split(","))
    elif args.does == "enter":
        chosen = {n: ENTRIES[n] for n in args.entry} | ({args.name: args.command} if args.name else {})
        for name, command in chosen.items():
            enter(args.suite, name, command, args.workers, args.timeout, args.cluster)
    else:
        print(table(args.suite)[0])


if __name__ == "__main__":
    main()
