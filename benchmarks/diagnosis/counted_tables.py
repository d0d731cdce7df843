"""The tables of `count_intervals.py score`: rates by kind of case, robot, true error of the data sheet and reality."""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from counted_cases import OTHERS, POOR, SEEDS, Plan, each_isolable, examined, plans
from score import Outcome, label, mcnemar

from bayessim_mjx.blind.outcome import LOOSE, alarm, covered, holds, labels_of, wilson

ERRORS = (0.02, 0.05, 0.10, 0.20, 0.30)  # a case belongs to the nearest of these scales, by ratio
NAMES, HOLDS = ("right", "exact", "inside", "false names"), ("strengths", "known", "known, other answers", "closed")
REALITIES = ("mujoco", *OTHERS)
BINS = (0.0, 0.2, 0.4, 0.6, 0.8)  # lower ends, of stated probabilities
SUFFIX = "_mult"  # of a known parameter in a diagnosis, a factor of the nominal value


@dataclass(frozen=True)
class Answer:
    """What one case adds to the tables; of one that did not end, nothing.

    rates: {measure: answers}; size: of the set, nan where nothing is named; untold: why something was not counted.
    stated: (probability of the answer, whether it is what is hidden, and no more). isolable: None: not examined.
    """

    plan: Plan
    state: str
    rates: dict[str, list[bool]]
    size: float = math.nan
    untold: tuple[str, ...] = ()
    cpu: float = math.nan
    said: str = ""
    stated: tuple[float, bool] | None = None
    isolable: bool | None = None


def answers(out: Path) -> list[Answer]:
    """Of all cases, in their order."""
    return [answer(plan, out / plan.name) for plan in plans()]


def answer(plan: Plan, folder: Path) -> Answer:
    path = folder / "result.json"
    if not path.exists():
        return Answer(plan, "unfinished" if (folder / "output.txt").exists() else "not begun", {})
    result = json.loads(path.read_text())
    if "truth" not in result:
        return Answer(plan, "not made", {})
    said = result.get("said")
    o = Outcome(folder, result["truth"], said, result.get("joints", {}), result.get("seconds", math.nan))
    if plan.group == "outside" and plan.kind == "unknown":
        own = {"unexplained": [label(o) == "unexplained"], "taken": [bool(o.named())]} if o.strong_enough else {}
        state = "no result" if said is None else "ended"
        return Answer(plan, state, own, cpu=result.get("cpu", math.nan), said=label(o))
    rates, untold = _names(o) if o.strong_enough else {}, [] if o.strong_enough else ["weaker than asked for"]
    if plan.kind == "null":
        rates = {"alarm": [alarm(o)]} if said else {}
    rates["strengths"] = covered(o)
    right = all(o.right(e) for e in o.truth["effects"])
    rates["known" if right and not _false(o) else "known, other answers"], missing = known(o)
    rates["closed"], more = closed(said or {}, result)
    untold += missing + more + [f"loose: {e['name']}" for e in o.truth["effects"] if e["name"] in LOOSE]
    state = "no result" if said is None else "ended"
    members = len(o.members()) if o.named() else math.nan
    apart = examined().get(plan.name)
    alone = None if apart is None else each_isolable(apart)
    cpu = result.get("cpu", math.nan)
    return Answer(plan, state, rates, members, tuple(untold), cpu, label(o), stated(o), alone)


def stated(o: Outcome) -> tuple[float, bool] | None:
    """(probability of the answer, whether it is what is hidden); None of a verdict that is none of the sets."""
    sets = {frozenset(x["effects"]): float(x["probability"]) for x in (o.said or {}).get("evidence", ())}
    if not o.strong_enough or not (o.named() or label(o) in ("no_gap", "parameters", "noise")):
        return None
    own = sets.get(frozenset(f"{f['name']}@{f['where']}" for f in o.named()))
    right = all(o.right(e) or _same(o, e) for e in o.truth["effects"]) and not _false(o)
    return None if own is None else (own, right)


def _same(o: Outcome, effect: dict[str, Any]) -> bool:
    """Whether an effect is told as one with the answer: its work is done by known parameters or by what is named."""
    said = o.said or {}
    labels = [*said.get("hidden", ()), *(x for p in said.get("parameters", {}).values() for x in p.get("same_as", ()))]
    return any(o.same(*label, effect) for entry in labels for label in labels_of(entry))


def _false(o: Outcome) -> list[str]:
    """Names that are not hidden."""
    named = [(f["name"], str(f["where"])) for f in o.named()]
    return [name for name, where in named if not any(o.same(name, where, e) for e in o.truth["effects"])]


def _names(o: Outcome) -> dict[str, list[bool]]:
    right, inside = (all(getattr(o, what)(e) for e in o.truth["effects"]) for what in ("right", "inside"))
    wrong = _false(o)
    return {"right": [right], "exact": [right and not wrong], "inside": [inside], "false names": [bool(wrong)]}


def known(o: Outcome) -> tuple[list[bool], list[str]]:
    """(whether what is said of each mass, damping and armature holds, a word for each of which nothing is said)."""
    told, true = (o.said or {}).get("parameters", {}), o.truth["base"]
    of = {name: told.get(name.replace(".", "_") + SUFFIX) for name in true}
    held = [holds(given, true[name] * (given.get("nominal") or 1.0)) for name, given in of.items() if given]
    return held, ["known parameters not told"] * (len(of) - len(held))


def closed(said: dict[str, Any], result: dict[str, Any]) -> tuple[list[bool], list[str]]:
    """(whether the interval of the closed share holds, why it was not asked)."""
    if not said.get("effects"):
        return [], []
    ends = said.get("gap", {}).get("closed", {}).get("ci") or (None, None)
    if None in ends:
        return [], ["no interval of the closed share"]
    if result.get("closed") is None:
        return [], ["no truth of the closed share"]
    return [bool(ends[0] <= result["closed"] <= ends[1])], []


def nearest(scale: float) -> float:
    return min(ERRORS, key=lambda e: abs(math.log(e / scale)))


Group = tuple[str, Callable[[Answer], bool]]


def tables(out: Path, before: Path | None = None) -> str:
    """All tables as text."""
    every = answers(out)
    by_reality: list[Group] = [(r, lambda a, r=r: a.plan.reality == r) for r in REALITIES]
    in_mujoco = [a for a in every if a.plan.reality == REALITIES[0]]
    sheets, logs, outside = (_of(in_mujoco, group) for group in ("sheets", "logs", "outside"))
    by_error: list[Group] = [(f"{100 * e:g} %", lambda a, e=e: nearest(a.plan.scale) == e) for e in ERRORS]
    by_kind: list[Group] = [(k, lambda a, k=k: a.plan.kind == k) for k in ("single", "double")]
    by_system: list[Group] = [(s, lambda a, s=s: a.plan.system == s) for s in SEEDS]
    by_isolable: list[Group] = [
        (f"{k}, {'' if own else 'not '}isolable", lambda a, k=k, own=own: a.plan.kind == k and a.isolable is own)
        for k in ("single", "double") for own in (True, False)
    ]  # fmt: skip
    apart: list[Group] = [
        (f"{r}, {k}, isolable", lambda a, r=r, k=k: a.plan.reality == r and a.plan.kind == k and a.isolable is True)
        for r in REALITIES for k in ("single", "double")
    ]  # fmt: skip
    by_logs: list[Group] = [(k, lambda a, k=k: a.plan.logs == k) for k in POOR]
    text = [
        f"Data sheets of any accuracy\n\n{_table(sheets, [*by_kind, *by_isolable, *by_system])}",
        f"By the scale of the true errors\n\n{_table(sheets, by_error)}",
        f"Few and poor logs\n\n{_table(logs, [*by_logs, *by_isolable[:2]])}",
        f"Nothing of the library\n\n{_outside(outside, by_system)}",
        f"Data sheets of any accuracy, by reality\n\n{_table(_of(every, 'sheets'), [*by_reality, *apart])}",
        f"Nothing of the library, by reality\n\n{_outside(_of(every, 'outside'), by_reality)}",
        f"Stated probabilities\n\n{_stated(every)}",
        _left_out(every),
    ]
    if before is not None:
        text.append(_compared(answers(before), every))
    return "\n\n".join(text)


def _table(some: Sequence[Answer], groups: Iterable[Group]) -> str:
    header = ["", "ended", *NAMES, "mean set", *HOLDS, "CPU s"]
    rows = [_row("all", some)] + [_row(name, [a for a in some if own(a)]) for name, own in groups]
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _row(name: str, some: Sequence[Answer]) -> list[str]:
    ended = sum(a.state in ("ended", "no result") for a in some)
    sizes = [a.size for a in some if math.isfinite(a.size)]
    spent = [a.cpu for a in some if math.isfinite(a.cpu)]
    size = f"{np.mean(sizes):.1f}" if sizes else "-"
    seconds = f"{np.median(spent):.0f} (max {max(spent):.0f})" if spent else "-"
    cells = {what: _rate([x for a in some for x in a.rates.get(what, [])]) for what in (*NAMES, *HOLDS)}
    names, held = [cells[w] for w in NAMES], [cells[w] for w in HOLDS]
    return [name, f"{ended} of {len(some)}", *names, size, *held, seconds]


def _of(some: Iterable[Answer], group: str) -> list[Answer]:
    return [a for a in some if a.plan.group == group]


def _outside(some: Sequence[Answer], groups: Iterable[Group]) -> str:
    header = ["", "nothing hidden: alarm", "cause outside the library: unexplained", "taken for an effect", "CPU s"]
    lines = [f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header))]
    for name, own in [("all", lambda _: True), *groups]:
        those = [a for a in some if own(a)]
        cells = [_rate([x for a in those for x in a.rates.get(what, [])]) for what in ("alarm", "unexplained", "taken")]
        spent = [a.cpu for a in those if math.isfinite(a.cpu)]
        lines.append(f"| {name} | {' | '.join(cells)} | {f'{np.median(spent):.0f}' if spent else '-'} |")
    return "\n".join(lines)


def _stated(every: Sequence[Answer]) -> str:
    said = [a.stated for a in every if a.stated is not None]
    if not said:
        return "none"
    lines = ["| stated | right |", "|---|---|"]
    for low in BINS:
        own = [x for x in said if low <= x[0] < low + 0.2 or x[0] == low + 0.2 == 1.0]
        lines += [f"| {np.mean([p for p, _ in own]):.2f} | {_rate([r for _, r in own])} |"] if own else []
    brier = np.mean([(p - r) ** 2 for p, r in said])
    return "\n".join([*lines, "", f"Brier score {brier:.3f} of {len(said)} answers"])


def _rate(given: Sequence[bool]) -> str:
    if not given:
        return "-"
    low, high = wilson(sum(given), len(given))
    share = 100 * sum(given) / len(given)
    return f"{sum(given)} of {len(given)}, {share:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _left_out(every: Sequence[Answer]) -> str:
    states = Counter(a.state for a in every)
    why = Counter(text for a in every for text in a.untold)
    told = "; ".join(f"{name}: {n}" for name, n in [*states.items(), *sorted(why.items())])
    return f"Of {len(every)} cases {told}. Rates with 95 % Wilson intervals."


def _compared(before: Sequence[Answer], after: Sequence[Answer]) -> str:
    """Cases that ended with both commits: measures of each, and cases that one alone has right."""
    pairs = [(a, b) for a, b in zip(before, after, strict=True) if a.said and b.said]
    lines = [f"Cases that ended with both: {len(pairs)}; before, now"]
    for what in (*NAMES, *HOLDS):
        both = [_rate([x for pair in pairs for x in pair[i].rates.get(what, [])]) for i in (0, 1)]
        line = f"{what}: {both[0]}; {both[1]}"
        if what in NAMES:
            each = [(a.rates[what][0], b.rates[what][0]) for a, b in pairs if what in a.rates and what in b.rates]
            only = [sum(x > y for x, y in each), sum(x < y for x, y in each)]
            line += f"; one alone: {only[0]}, {only[1]} (p {mcnemar(*only):.2f})"
        lines.append(line)
    return "\n".join(lines)
