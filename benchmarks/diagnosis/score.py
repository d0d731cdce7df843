"""What diagnosis.json files are worth against sealed truths: rates with Wilson intervals, coverage, confusions."""

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from isolable import each_isolable

from bayessim_mjx.blind import outcome as judged
from bayessim_mjx.blind.outcome import LOOSE, VERDICTS, covered, holds, label, labels_of, wilson

__all__ = ["LOOSE", "Outcome", "confusion", "holds", "label", "labels_of", "rates", "read", "wilson"]

GOALS = {"weak": 3.0, "medium": 10.0, "strong": 30.0, "severe": 100.0}
REACHED = 0.8  # of the strength that was asked for, or the case does not count


@dataclass(frozen=True)
class Outcome(judged.Outcome):
    """One case of the benchmark, with what its worker tells."""

    compile_seconds: float = math.nan
    true_closure: float | None = None  # what the true effects close, fitted by the same search
    isolable: bool | None = None  # None: not looked at

    @property
    def strong_enough(self) -> bool:
        goal = REACHED * GOALS[self.truth["strength"]]
        return all(min(e["raw"], 3 * e["left"]) >= goal for e in self.truth["effects"])


def read(folder: Path, results: str = "diagnosis", baseline: str | None = None) -> Outcome:
    """One case as the diagnosis, or one of the baselines on its fits, tells it."""
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    joints = {model.actuator(i).name: model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)}
    truth, where = json.loads((folder / "truth.json").read_text()), folder / results
    said = (
        _json(where / "diagnosis.json") if baseline is None else (_json(where / "baselines.json") or {}).get(baseline)
    )
    ended, oracle, rivals = (
        _json(where / "exit.json") or {},
        _json(where / "oracle.json") or {},
        _json(folder / "isolable.json"),
    )
    seconds = ended.get("seconds", math.nan) if baseline is None else (said or {}).get("seconds", math.nan)
    return Outcome(
        folder, truth, said, joints, seconds,
        compile_seconds=ended.get("compile_seconds", math.nan), true_closure=oracle.get("closure"),
        isolable=None if rivals is None else each_isolable(rivals, truth),
    )  # fmt: skip


def _json(path: Path) -> Any:
    return json.loads(path.read_text()) if path.exists() else None


def mcnemar(a: int, b: int) -> float:
    """Two-sided exact p of McNemar's test: cases that one of two rules alone has right split as unevenly by chance."""
    n = a + b
    return min(1.0, 2.0 * sum(math.comb(n, k) for k in range(min(a, b) + 1)) / 2**n)


def closure_errors(outcomes: Sequence[Outcome]) -> list[float]:
    """|share of the gap that what is named closes - share the true effects close|; nothing named closes nothing."""
    told = [o for o in outcomes if o.said and o.true_closure is not None]
    return [abs(sum(f["gap_closed"] or 0.0 for f in o.named()) - o.true_closure) for o in told]


@dataclass(frozen=True)
class Rate:
    """What is asked, the answer of every case that counts, and the goal: at least, or (`most`) at most.

    size: mean number of effect@place in the sets that were asked whether the truth is in them; nan of no sets.
    """

    what: str
    answers: list[bool]
    goal: float
    most: bool = False
    size: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        low, high = wilson(sum(self.answers), len(self.answers))
        hits, n = sum(self.answers), len(self.answers)
        told = {"hits": hits, "n": n, "low": low, "high": high, "goal": self.goal, "at_most": self.most}
        return told | ({"set_size": self.size} if math.isfinite(self.size) else {})

    @property
    def told(self) -> str:
        """What is asked, and of sets of which size."""
        return f"{self.what}, sets of {self.size:.1f}" if math.isfinite(self.size) else self.what

    @property
    def text(self) -> str:
        """ "93 %", or nothing where nothing was asked."""
        return f"{100 * sum(self.answers) / len(self.answers):.0f} %" if self.answers else "-"


def rates(outcomes: Sequence[Outcome], left_out: Sequence[Outcome] = ()) -> list[Rate]:
    """The measures over all cases whose hidden effects are as strong as asked for."""
    of: Callable[[str], list[Outcome]] = lambda kind: [o for o in outcomes if o.kind == kind and o.strong_enough]  # noqa: E731
    single, double, unknown = of("single"), of("double"), of("unknown")
    null = [o for o in of("null") if o.said]  # a failure is no alarm; the footer counts them
    right = lambda o: all(o.right(e) for e in o.truth["effects"])  # noqa: E731
    inside = lambda o: all(o.inside(e) for e in o.truth["effects"])  # noqa: E731
    left_out = [o for o in left_out if o.strong_enough]
    errors = closure_errors(single)
    return [
        Rate("single, isolable: effect and place named", [right(o) for o in single if o.isolable], 0.95),
        Rate("single, all: effect and place named", [right(o) for o in single], 0.95),
        Rate("single: effect named, any place", [_names(o) for o in single], 0.95),
        Rate("single: truth in the equivalence set", [inside(o) for o in single], 0.98, size=set_size(single)),
        Rate("single: nothing else named", [right(o) and len(o.named()) == 1 for o in single], 0.9),
        Rate("double, each isolable alone: both named", [right(o) for o in double if o.isolable], 0.85),
        Rate("double: both named", [right(o) for o in double], 0.85),
        Rate("double: both in the equivalence set", [inside(o) for o in double], 0.85, size=set_size(double)),
        Rate(
            "nothing wrong: false alarm",
            [label(o) not in ("no_gap", "parameters", "noise") for o in null],
            0.02,
            most=True,
        ),
        Rate("unknown cause: unexplained", [_unexplained(o) for o in unknown], 0.9),
        Rate("family left out: unexplained", [_unexplained(o) for o in left_out], 0.9),
        Rate("unknown cause or family left out: unexplained", [_unexplained(o) for o in (*unknown, *left_out)], 0.9),
        Rate("closure within 5 points of the truth's", [e <= 0.05 for e in errors], 0.9),
        Rate("90 % intervals that cover", [c for o in (*single, *double) for c in covered(o)], 0.9),
    ]


def set_size(outcomes: Sequence[Outcome]) -> float:
    """Mean number of effect@place in an answer, of those that name something: the price of a truth that is inside."""
    sizes = [len(o.members()) for o in outcomes if o.named()]
    return float(np.mean(sizes)) if sizes else math.nan


def _unexplained(outcome: Outcome) -> bool:
    return bool(outcome.said) and outcome.said["verdict"] == "unexplained"


def _names(outcome: Outcome) -> bool:
    return outcome.truth["effects"][0]["name"] in {f["name"] for f in outcome.named()}


def confusion(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], np.ndarray]:
    """(rows, columns, counts): hidden (singles, nothing, an unknown cause) against named first, or the verdict."""
    pairs: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        if len(o.truth["effects"]) <= 1 and o.strong_enough:
            pairs[next((e["name"] for e in o.truth["effects"]), "nothing"), label(o)] += 1
    effects = sorted({h for h, _ in pairs} | {s for _, s in pairs} - set(VERDICTS))
    rows = [e for e in effects if any(h == e for h, _ in pairs)]
    columns = [e for e in effects if any(s == e for _, s in pairs)] + [
        v for v in VERDICTS if any(s == v for _, s in pairs)
    ]
    return rows, columns, np.array([[pairs[r, c] for c in columns] for r in rows], int).reshape(len(rows), len(columns))
