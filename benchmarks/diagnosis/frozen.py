"""What a change of the diagnosis does to 60 fixed cases: their verdicts, effects, numbers and CPU seconds.

    python benchmarks/diagnosis/count_intervals.py run OUT --only frozen
    python benchmarks/diagnosis/frozen.py compare OUT         # with frozen.json; ends with 1 where an answer differs
    python benchmarks/diagnosis/frozen.py record OUT COMMIT   # OUT's results are what later commits are compared with

A number differs if it lies more than half of its recorded standard deviation away. Seconds depend on the machine: a
comparison of them needs the recorded commit again, on the same cores.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

RECORD = Path(__file__).with_name("frozen.json")
MOVED = 0.5  # standard deviations
NUMBERS, TEXTS = ("mean", "sd"), 3  # of an effect's parameter; digits that are kept


def answers(out: Path) -> dict[str, dict[str, Any]]:
    """{case: what was said} of those that have ended."""
    from counted_cases import frozen

    found = {}
    for plan in frozen():
        path = out / plan.name / "result.json"
        if path.exists():
            found[plan.name] = answer(json.loads(path.read_text()))
    return found


def answer(result: dict[str, Any]) -> dict[str, Any]:
    """Verdict, {effect@place: {parameter: [mean, sd]}}, hidden effects and CPU seconds of one case."""
    said = result.get("said") or {}
    effects = {
        f"{e['name']}@{e['where']}": {n: [_short(p.get(k)) for k in NUMBERS] for n, p in e["parameters"].items()}
        for e in said.get("effects", ())
    }
    hidden = [f"{e['name']}@{e['where']}" for e in result.get("truth", {}).get("effects", ())]
    cpu = round(result["cpu"], 1) if "cpu" in result else None
    return {"verdict": said.get("verdict"), "effects": effects, "hidden": hidden, "cpu": cpu}


def _short(x: float | None) -> float | None:
    return None if x is None else float(f"{x:.{TEXTS}g}")


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """In words, of one case."""
    out = [] if before["verdict"] == now["verdict"] else [f"verdict {before['verdict']} -> {now['verdict']}"]
    gone, new = (sorted(set(a["effects"]) - set(b["effects"])) for a, b in ((before, now), (now, before)))
    out += [f"lost {', '.join(gone)}"] * bool(gone) + [f"new {', '.join(new)}"] * bool(new)
    for label in sorted(set(before["effects"]) & set(now["effects"])):
        for name, (mean, sd) in before["effects"][label].items():
            there = now["effects"][label].get(name, [None, None])[0]
            if mean is None or there is None:
                out += [f"{label} {name} {mean} -> {there}"] * (mean != there)
            elif abs(there - mean) > MOVED * (sd or 0.0) + 10.0 ** (1 - TEXTS) * abs(mean):
                out.append(f"{label} {name} {mean} +- {sd} -> {there}")
    return out


def compare(out: Path) -> int:
    """Print what differs; the exit code."""
    record, now = json.loads(RECORD.read_text()), answers(out)
    both = [case for case in record["cases"] if case in now]
    changed = {c: d for c in both if (d := differences(record["cases"][c], now[c]))}
    for case, words in changed.items():
        print(f"{case} (hidden: {', '.join(record['cases'][case]['hidden']) or 'nothing'}): {'; '.join(words)}")
    pairs = [(record["cases"][c]["cpu"], now[c]["cpu"]) for c in both if record["cases"][c]["cpu"] and now[c]["cpu"]]
    times = f"; CPU seconds, median of the ratios: {np.median([b / a for a, b in pairs]):.2f}" if pairs else ""
    print(f"{len(both)} of {len(record['cases'])} cases, {len(changed)} differ from {record['commit']}{times}")
    return int(bool(changed))


def record(out: Path, commit: str) -> None:
    """Write frozen.json, one case a line."""
    cases = answers(out)
    lines = ",\n".join(f"    {json.dumps(name)}: {json.dumps(said)}" for name, said in cases.items())
    RECORD.write_text(f'{{\n  "commit": {json.dumps(commit)},\n  "cases": {{\n{lines}\n  }}\n}}\n')
    print(f"{len(cases)} cases of {commit}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="does")
    for name in ("compare", "record"):
        command = commands.add_parser(name)
        command.add_argument("out", type=Path)
        if name == "record":
            command.add_argument("commit")
    args = parser.parse_args()
    if args.does == "record":
        record(args.out, args.commit)
    else:
        sys.exit(compare(args.out))


if __name__ == "__main__":
    main()
