"""Scores diagnosis.json files against sealed truths: rates with Wilson intervals, coverage, confusion matrix."""

import csv
import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

Z = 1.645  # 90 %
GOALS = {"weak": 3.0, "medium": 10.0, "strong": 30.0, "severe": 100.0}
REACHED = 0.8  # of the strength that was asked for, or the case does not count


@dataclass(frozen=True)
class Outcome:
    """One case: its truth, its diagnosis (None where there is none), and whether two places are the same."""

    folder: Path
    truth: dict[str, Any]
    said: dict[str, Any] | None
    joint_of: dict[str, str]
    seconds: float

    @property
    def kind(self) -> str:
        return self.truth.get("kind") or ("null", "single", "double")[len(self.truth["effects"])]

    @property
    def strong_enough(self) -> bool:
        goal = REACHED * GOALS[self.truth["strength"]]
        return all(min(e["raw"], 3 * e["left"]) >= goal for e in self.truth["effects"])

    def named(self) -> list[dict[str, Any]]:
        """Effects of the verdict; of one that names none, an empty list."""
        return self.said["effects"] if self.said and self.said["verdict"] in ("effects", "ambiguous") else []

    def same(self, name: str, where: str, effect: dict[str, Any]) -> bool:
        """Whether a named effect at a place is the hidden one; actuators and their joints are one place."""
        if name != effect["name"]:
            return False
        at = self.joint_of.get(effect["where"], effect["where"])
        given = [self.joint_of.get(w, w) for w in where.replace("+", ",").split(",")]
        return at == "world" or at in given or (where == "all" and len(set(self.joint_of.values())) <= 1)

    def right(self, effect: dict[str, Any]) -> bool:
        return any(self.same(f["name"], str(f["where"]), effect) for f in self.named())

    def best(self, effects: Sequence[dict[str, Any]]) -> bool:
        """Baseline (single-fold error, as BAM does): the candidate that predicts best is the truth, no thresholds."""
        ranked = [c for c in (self.said or {}).get("candidates", []) if c.get("score") is not None]
        top = _labels(ranked[0]) if ranked else []
        return len(top) == len(effects) and all(any(self.same(*t, e) for t in top) for e in effects)

    def inside(self, effect: dict[str, Any]) -> bool:
        """Named, or in the set of what cannot be told from what is named."""
        rivals = [label for f in self.named() for entry in f["equivalent_to"] for label in _labels(entry)]
        return self.right(effect) or any(self.same(*label, effect) for label in rivals)


def _labels(entry: Any) -> list[tuple[str, str]]:
    """ "effect@place" labels of an entry of equivalent_to, however it is written."""
    if isinstance(entry, str):
        name, _, where = entry.partition("@")
        return [(name, where)]
    if "effects" in entry:
        return [label for e in entry["effects"] for label in _labels(e)]
    return [(entry["name"], str(entry.get("where", "")))]


def read(folder: Path, results: str = "diagnosis") -> Outcome:
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    joints = {model.actuator(i).name: model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)}
    path, ended = folder / results / "diagnosis.json", folder / results / "exit.json"
    said = json.loads(path.read_text()) if path.exists() else None
    seconds = json.loads(ended.read_text())["seconds"] if ended.exists() else math.nan
    return Outcome(folder, json.loads((folder / "truth.json").read_text()), said, joints, seconds)


def wilson(hits: int, n: int, z: float = Z) -> tuple[float, float]:
    """Interval of a rate."""
    if not n:
        return 0.0, 1.0
    p, z2 = hits / n, z * z
    middle, half = p + z2 / (2 * n), z * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    return (middle - half) / (1 + z2 / n), (middle + half) / (1 + z2 / n)


def covered(outcome: Outcome) -> list[bool]:
    """Of the rightly named effects: whether each parameter with the same meaning lies in its 90 % interval."""
    found = []
    for effect in outcome.truth["effects"]:
        for f in outcome.named():
            if not outcome.same(f["name"], str(f["where"]), effect):
                continue
            for name, value in effect["parameters"].items():
                given = f["parameters"].get(name)
                if given and given["sd"]:
                    found.append(abs(given["mean"] - value) <= Z * given["sd"])
    return found


def closure_errors(singles: Sequence[Outcome]) -> list[float]:
    """|gap closed - 1|: less its effect, reality is the model at other base parameters: the true effect closes all."""
    return [
        abs(sum(f["gap_closed"] for f in o.named()) - 1.0)
        for o in singles
        if o.right(o.truth["effects"][0]) and all(f["gap_closed"] is not None for f in o.named())
    ]


def label(outcome: Outcome) -> str:
    """Column of the confusion matrix: the first effect named, else the verdict."""
    if not outcome.said:
        return "no result"
    return outcome.named()[0]["name"] if outcome.named() else str(outcome.said["verdict"])


Rate = tuple[str, list[bool], float]


def rates(outcomes: Sequence[Outcome], left_out: Sequence[Outcome]) -> list[Rate]:
    """(what is asked, answers, goal)."""
    of: Callable[[str], list[Outcome]] = lambda kind: [o for o in outcomes if o.kind == kind and o.strong_enough]  # noqa: E731
    single, double = of("single"), of("double")
    null = [o for o in of("null") if o.said]  # a failure is no alarm; the footer counts them
    unknown = of("unknown")
    return [
        ("single: effect and place named", [o.right(o.truth["effects"][0]) for o in single], 0.95),
        ("single: effect named, any place", [_names(o) for o in single], 0.95),
        ("single: truth in the equivalence set", [o.inside(o.truth["effects"][0]) for o in single], 0.98),
        ("single: nothing else named", [o.right(o.truth["effects"][0]) and len(o.named()) == 1 for o in single], 0.9),
        ("double: both named", [all(o.right(e) for e in o.truth["effects"]) for o in double], 0.85),
        ("double: both in the set", [all(o.inside(e) for e in o.truth["effects"]) for o in double], 0.85),
        ("nothing wrong: false alarm", [label(o) not in ("no_gap", "parameters") for o in null], 0.02),
        ("unknown cause: unexplained", [_unexplained(o) for o in unknown], 0.9),
        ("family left out: unexplained", [_unexplained(o) for o in left_out], 0.9),
        ("single, baseline: best candidate", [o.best([o.truth["effects"][0]]) for o in single], 0.95),
        ("nothing wrong, baseline: false alarm", [not o.best([]) for o in null], 0.02),
        ("90 % intervals that cover", [c for o in (*single, *double) for c in covered(o)], 0.9),
        ("closure within 5 points", [e <= 0.05 for e in closure_errors(single)], 0.9),
    ]  # fmt: skip


def _unexplained(outcome: Outcome) -> bool:
    return bool(outcome.said) and outcome.said["verdict"] == "unexplained"


def _names(outcome: Outcome) -> bool:
    return outcome.truth["effects"][0]["name"] in {f["name"] for f in outcome.named()}


def score(folders: Sequence[Path], out: Path) -> str:
    """Write score.md, score.json and confusion.csv; the former's text."""
    every = [read(f) for f in folders]
    outcomes = [o for o in every if o.said or not math.isnan(o.seconds)]
    left_out = [read(f, "left_out") for f in folders if (f / "left_out" / "exit.json").exists()]
    table = ["| measure | rate | 90 % interval | n | goal |", "|---|---|---|---|---|"]
    numbers: dict[str, Any] = {}
    for what, answers, goal in rates(outcomes, left_out):
        hits, n = sum(answers), len(answers)
        low, high = wilson(hits, n)
        rate = f"{100 * hits / n:.0f} %" if n else "-"
        table.append(f"| {what} | {rate} | {100 * low:.0f} to {100 * high:.0f} % | {n} | {100 * goal:.0f} % |")
        numbers[what] = {"hits": hits, "n": n, "low": low, "high": high, "goal": goal}
    lines = [*table, "", *_breakdown(outcomes), "", *_footer(every, outcomes)]
    out.mkdir(parents=True, exist_ok=True)
    (out / "score.json").write_text(json.dumps(numbers, indent=1))
    (out / "score.md").write_text("\n".join(lines) + "\n")
    confusion(outcomes, out / "confusion.csv")
    return "\n".join(lines)


def _breakdown(outcomes: Sequence[Outcome]) -> list[str]:
    """Singles by effect: right, in the set, and what was said instead."""
    lines = ["| hidden effect | n | named | in the set | said instead |", "|---|---|---|---|---|"]
    singles = [o for o in outcomes if o.kind == "single" and o.strong_enough]
    for name in sorted({o.truth["effects"][0]["name"] for o in singles}):
        own = [o for o in singles if o.truth["effects"][0]["name"] == name]
        right, inside = (sum(getattr(o, k)(o.truth["effects"][0]) for o in own) for k in ("right", "inside"))
        wrong = Counter(label(o) for o in own if not o.right(o.truth["effects"][0]))
        said = ", ".join(f"{what} {n}" for what, n in wrong.most_common())
        lines.append(f"| {name} | {len(own)} | {right} | {inside} | {said} |")
    return lines


def _footer(every: Sequence[Outcome], outcomes: Sequence[Outcome]) -> list[str]:
    weak = sum(not o.strong_enough for o in outcomes)
    failed = sum(o.said is None for o in outcomes)
    seconds = [o.seconds for o in outcomes if math.isfinite(o.seconds)]
    took = f"median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s" if seconds else "no times"
    return [
        f"{len(outcomes)} of {len(every)} cases run; {failed} without a result; {weak} not counted because the effect "
        f"cannot be as strong as asked on that robot; {took} per case."
    ]


def confusion(outcomes: Sequence[Outcome], path: Path) -> None:
    """Rows: what was hidden (singles, nothing, unknown causes). Columns: what was named first, or the verdict."""
    pairs = Counter()
    for o in outcomes:
        if len(o.truth["effects"]) <= 1 and o.strong_enough:
            pairs[next((e["name"] for e in o.truth["effects"]), "nothing"), label(o)] += 1
    rows, columns = (sorted({p[i] for p in pairs}) for i in (0, 1))
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["hidden", *columns])
        table.writerows([r, *(pairs[r, c] for c in columns)] for r in rows)
