"""Which answers change where a number of the diagnosis is halved or doubled.

    python benchmarks/diagnosis/sensitivity.py --cases frozen --numbers all --out benchmarks/records/sensitivity.json
        [--workers N] [--cluster WHERE] [--minutes M] [--folder logs/sensitivity] [--page docs/decisions/numbers.md]

Numbers are those of `bayessim_mjx.diagnosis.selection.numbers`, as `Priors.least` or `HIDDEN`, or `MODULE:NAME` for one
of another module of the diagnosis. A number is replaced in the text of its module before anything imports it: what is
derived from it changes too. Whole numbers are rounded, and at least 1. Of a tuple each entry but 1 is changed. Of a
number around 1, which stands for no difference, its distance from 1 is halved or doubled.

Each case runs once unchanged, and once for each number and factor, each run as a process on one core that writes
FOLDER/CASE/RUN/result.json. When the minutes are over, running ones are killed; the same command goes on from there.
The record compares those that have ended. A probability is that of the named set, or of the unchanged run's set where
the names differ. `--page` puts the counts into the table of that page.
"""

import argparse
import ast
import importlib.util
import json
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from count_intervals import PLAN, RESULT, SECONDS, side_by_side, variables

from bayessim_mjx import pool

ROOT = Path(__file__).parents[2]
PACKAGE, OWN = "bayessim_mjx.diagnosis", "selection.numbers"
FACTORS = {"halved": 0.5, "doubled": 2.0}
UNCHANGED, MADE, CHANGE = "unchanged", "made", "change.json"
NEAR_ONE = 0.5, 2.0  # between these a number counts from 1
MOVED = 0.1  # change of a probability that is counted


def numbers(module: str = OWN) -> list[str]:
    """Names of the numeric constants and dataclass fields of a module of the diagnosis."""
    tree = ast.parse(_file(module).read_text(encoding="utf-8"))
    return [name for name, node in _assigned(tree) if _numeric(node.value)]


def _file(module: str) -> Path:
    return ROOT / Path(*f"{PACKAGE}.{module}".split(".")).with_suffix(".py")


def _assigned(tree: ast.Module) -> Iterable[tuple[str, Any]]:
    """(name, assignment) of a module's constants and of its classes' fields."""
    for node in tree.body:
        owner = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
        for own in node.body if isinstance(node, ast.ClassDef) else [node]:
            if isinstance(own, ast.AnnAssign) and own.value is not None:
                yield owner + ast.unparse(own.target), own
            elif isinstance(own, ast.Assign):
                yield owner + ast.unparse(own.targets[0]), own


def _numeric(node: ast.expr) -> bool:
    try:
        value = ast.literal_eval(node)
    except ValueError:
        return False
    each = value if isinstance(value, tuple) else (value,)
    return bool(each) and all(isinstance(x, int | float) and not isinstance(x, bool) for x in each)


def value_of(number: str) -> Any:
    """The value in the source of `NAME` or `MODULE:NAME`."""
    module, name = split(number)
    found = [node for own, node in _assigned(ast.parse(_file(module).read_text(encoding="utf-8"))) if own == name]
    if len(found) != 1 or not _numeric(found[0].value):
        raise SystemExit(f"{number}: no number of {_file(module)}; it has {', '.join(numbers(module))}")
    return ast.literal_eval(found[0].value)


def split(number: str) -> tuple[str, str]:
    """(module, name)."""
    module, _, name = number.rpartition(":")
    return module or OWN, name


def changed(value: Any, factor: float) -> Any:
    """The number halved or doubled, see above."""
    if isinstance(value, tuple):
        return tuple(x if x == 1 else changed(x, factor) for x in value)
    if isinstance(value, int):
        return max(1, round(value * factor))
    if NEAR_ONE[0] < value < NEAR_ONE[1] and value != 1:
        return 1 + factor * (value - 1)
    return value * factor


def plant(number: str, value: Any) -> None:
    """Import the number's module with another value in the place of its own; nothing may have imported it before."""
    short, name = split(number)
    module = f"{PACKAGE}.{short}"
    if module in sys.modules:
        raise RuntimeError(f"{module} has been imported")
    tree = ast.parse(_file(short).read_text(encoding="utf-8"))
    for own, node in _assigned(tree):
        if own == name:
            node.value = ast.copy_location(ast.parse(repr(value), mode="eval").body, node.value)
    spec = importlib.util.find_spec(module)
    if spec is None or module in sys.modules:
        raise RuntimeError(f"{module} is imported by its own package")
    new = importlib.util.module_from_spec(spec)
    sys.modules[module] = new
    exec(compile(ast.fix_missing_locations(tree), str(_file(short)), "exec"), new.__dict__)
    parent, _, leaf = module.rpartition(".")
    setattr(sys.modules[parent], leaf, new)


def one(folder: Path) -> None:
    """One run in this process, with its logs from the case's folder; makes them if it is the unchanged run."""
    result: dict[str, Any] = {}
    try:
        change = json.loads((folder / CHANGE).read_text())
        if change:
            plant(change["number"], ast.literal_eval(change["value"]))
        made = folder.parent / MADE
        if not made.exists():
            _make(folder.parent)
        import worker

        worker.without_pictures()
        began = time.process_time()
        words = ["--model", made / "model.xml", "--data", made / "logs", "--out", folder / "diagnosis", "--seed", "0"]
        result["code"], seconds, found = worker.watched([*map(str, words), "--headless", "--verdict_only"])
        result |= seconds | {"cpu": time.process_time() - began}
        result["simulated"] = found.setup.fitter.simulator.rollouts if found else None
        file = folder / "diagnosis" / "diagnosis.json"
        result["said"] = _answer(json.loads(file.read_text())) if file.exists() else None
    except Exception:
        result["error"] = traceback.format_exc()
    result["all_cpu"] = time.process_time()
    _write(folder / RESULT, result)
    shutil.rmtree(folder / "diagnosis", ignore_errors=True)


def _make(case: Path) -> None:
    """Model, logs and truth of a case, complete once the folder has its name."""
    from counted_cases import Plan, make

    given = json.loads((case / PLAN).read_text())
    making = case / f"{MADE}.part"
    shutil.rmtree(making, ignore_errors=True)
    make(Plan(**given | {"effects": tuple(given["effects"])}), making)
    making.rename(case / MADE)


def _answer(said: dict[str, Any]) -> dict[str, Any]:
    """Verdict, named effects, and {effects of a set: probability}."""
    sets = {" + ".join(e["effects"]): e["probability"] for e in said.get("evidence", ())}
    names = sorted(f"{e['name']}@{e['where']}" for e in said["effects"])
    return {"verdict": said["verdict"], "effects": names, "sets": sets}


def _write(path: Path, content: Any) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(content, default=float))
    part.replace(path)


def jobs(folder: Path, cases: Sequence[Any], chosen: Sequence[str]) -> list[Path]:
    """Folders of all runs, written: unchanged ones first, then case by case, the slowest case first."""
    import dataclasses

    cases = sorted(cases, key=lambda p: -SECONDS[p.system] * max(len(p.effects), 1))
    out = []
    for case in cases:
        (folder / case.name).mkdir(parents=True, exist_ok=True)
        (folder / case.name / PLAN).write_text(json.dumps(dataclasses.asdict(case)))
        out.append(_job(folder / case.name / UNCHANGED, {}))
    values = {number: value_of(number) for number in chosen}
    for case in cases:
        for number in chosen:
            for word, factor in FACTORS.items():
                new = changed(values[number], factor)
                if new != values[number]:
                    out.append(
                        _job(folder / case.name / run_name(number, word), {"number": number, "value": repr(new)})
                    )
    return out


def _job(folder: Path, change: dict[str, str]) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / CHANGE).write_text(json.dumps(change))
    return folder


def run_name(number: str, word: str) -> str:
    return f"{number.replace(':', '.')}_{word}"


def run(todo: Sequence[Path], workers: int | None, minutes: float, cluster: str = "") -> None:
    """All runs without a result, one core each, until the minutes are over."""
    waiting, end = [f for f in todo if not (f / RESULT).exists()], time.time() + 60 * minutes
    print(f"{len(waiting)} of {len(todo)} runs, {minutes:g} minutes", flush=True)
    with pool.executor(cluster, workers, share=False) as calls:
        side_by_side(  # those of a case begin when its logs are there
            waiting, lambda f: calls.submit(pool.alone, _words(f), f / "output.txt", end, variables()), _line,
            lambda f: f.name == UNCHANGED or (f.parent / MADE).exists(),
        )  # fmt: skip


def _words(folder: Path) -> list[str]:
    return [sys.executable, str(Path(__file__).resolve()), "--one", str(folder)]


def _line(folder: Path) -> str:
    where = f"{folder.parent.name} {folder.name}"
    if not (folder / RESULT).exists():
        return f"{where}: no result"
    result = json.loads((folder / RESULT).read_text())
    said, failed = result.get("said") or {}, result.get("error", "").strip().splitlines()[-1:]
    return f"{where}: {said.get('verdict', 'no result')} {', '.join(said.get('effects', ()))} {''.join(failed)}"


def compared(before: dict[str, Any], now: dict[str, Any]) -> tuple[bool, bool, float]:
    """(whether the verdict differs, whether the effects do, change of the probability of the set named before)."""
    own = _probability(before, before["effects"]), _probability(now, before["effects"])
    return before["verdict"] != now["verdict"], before["effects"] != now["effects"], own[1] - own[0]


def _probability(said: dict[str, Any], names: Sequence[str]) -> float:
    return float(next((p for key, p in said["sets"].items() if sorted(filter(None, key.split(" + "))) == names), 0.0))


def record(folder: Path, cases: Sequence[str], chosen: Sequence[str], commit: str, command: str) -> dict[str, Any]:
    """The record: a row for each number and factor, counts over the cases that have ended."""
    rows, seen = [], set[str]()
    unchanged = {c: s for c in cases if (s := _said(folder / c / UNCHANGED))}
    for number in chosen:
        for word, factor in FACTORS.items():
            found = {c: (unchanged[c], s) for c in unchanged if (s := _said(folder / c / run_name(number, word)))}
            if not found:
                continue
            seen |= set(found)
            each = {c: compared(before[0], now[0]) for c, (before, now) in found.items()}
            effort = sorted(now[1] / before[1] for before, now in found.values())
            counts = [
                *(str(sum(e[i] for e in each.values())) for i in (0, 1)),
                str(sum(abs(e[2]) > MOVED for e in each.values())),
                f"{max(abs(e[2]) for e in each.values()):.2f}",
                f"{effort[len(effort) // 2]:.2f}",
            ]
            which = ", ".join(c for c, e in each.items() if e[0] or e[1])
            to = changed(value_of(number), factor)
            rows.append([f"{number} {word}", _short(value_of(number)), _short(to), str(len(each)), *counts, which])
    return {
        "section": "Diagnosis of fresh cases",
        "claim": "Answers that change where a number of the search is halved or doubled",
        "goal": "none of the verdicts",
        "commit": commit,
        "command": command,
        "machine": "one core a run",
        "shown": "no",
        "note": f"Probability: of the unchanged run's answer. Cases: {', '.join(c for c in cases if c in seen)}.",
        "columns": ["number", "value", "changed to", "cases", "verdicts that change", "effects that change",
                    f"probabilities that move by more than {MOVED}", "largest move", "simulated windows", "which"],
        "table": rows,
    }  # fmt: skip


def _said(folder: Path) -> tuple[dict[str, Any], int] | None:
    """(answer, simulated windows) of a run that has ended."""
    if not (folder / RESULT).exists():
        return None
    result = json.loads((folder / RESULT).read_text())
    return (result["said"], result["simulated"]) if result.get("said") else None


def _short(value: Any) -> str:
    return ", ".join(f"{x:.4g}" for x in (value if isinstance(value, tuple) else (value,)))


def written(found: dict[str, Any]) -> str:
    """The record as JSON, a line for each field and each row of the table."""
    fields = [f" {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in found.items() if k != "table"]
    rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in found["table"])
    return "{\n" + ",\n".join(fields) + f',\n "table": [\n{rows}\n ]\n}}\n'


def paged(text: str, found: dict[str, Any]) -> str:
    """A page whose table has the counts in its last two cells: of each number its first cell, in backticks, names."""
    rows = {row[0]: row for row in found["table"]}
    lines = text.split("\n")
    for i, line in enumerate(lines):
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        name = cells[0].strip("`")
        if line.startswith("| `") and any(f"{name} {word}" in rows for word in FACTORS):
            counts = [_cell(rows.get(f"{name} {word}")) for word in FACTORS]
            lines[i] = f"| {' | '.join([*cells[:-2], *counts])} |"
    return "\n".join(lines)


def _cell(row: Sequence[str] | None) -> str:
    return f"{row[4]}, {row[5]}, {row[6]} of {row[3]}" if row else "not counted"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="frozen", help="frozen, or names of counted cases, separated by commas")
    parser.add_argument("--numbers", default="all", help="all, or some, separated by commas")
    parser.add_argument("--out", type=Path, help="the record to write")
    parser.add_argument("--workers", type=int, help="runs at once, one core each (default: as many as cores)")
    parser.add_argument("--cluster", **pool.CLUSTER)
    parser.add_argument("--minutes", type=float, default=1e6, help="when they are over, running ones are killed")
    parser.add_argument("--folder", type=Path, default=ROOT / "logs" / "sensitivity", help="of all runs")
    parser.add_argument("--commit", default="", help="of the record; default: the checkout's")
    parser.add_argument("--page", type=Path, help="page whose table gets the counts")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    return parser


def main() -> None:
    args = _parser().parse_args()
    if args.one is not None:
        one(args.one)
        return
    from counted_cases import frozen, plans

    names = [p.name for p in frozen()] if args.cases == "frozen" else args.cases.split(",")
    known = {p.name: p for p in plans()}
    if unknown := [n for n in names if n not in known]:
        raise SystemExit(f"no such cases: {', '.join(unknown)}")
    chosen = numbers() if args.numbers == "all" else args.numbers.split(",")
    run(jobs(args.folder.resolve(), [known[n] for n in names], chosen), args.workers, args.minutes, args.cluster)
    if args.out is not None:
        commit = (
            args.commit
            or subprocess.run(
                ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
            ).stdout.strip()
        )
        shown = f"python benchmarks/diagnosis/sensitivity.py --cases {args.cases} --numbers {args.numbers} --out FILE"
        found = record(args.folder, names, chosen, commit, shown)
        args.out.write_text(written(found), encoding="utf-8")
        if args.page is not None:
            args.page.write_text(paged(args.page.read_text(encoding="utf-8"), found), encoding="utf-8")


if __name__ == "__main__":
    main()
