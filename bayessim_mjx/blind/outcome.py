"""A diagnosis.json judged against an opened truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Z90, Z95 = 1.645, 1.960
# parameters that do not mean the same in the finer reality and in the library (another pivot, gusts, signed loads)
LOOSE = ("base_flexibility", "external_force", "load_friction")
ONE_SIDED = {"at least": 1.0, "at most": -1.0}  # ends of ranges beyond which nothing was tried
VERDICTS = ("no_gap", "parameters", "noise", "unexplained", "insufficient_data", "no result")


@dataclass(frozen=True)
class Outcome:
    """One case: its truth, its diagnosis (None where there is none), and which joint each actuator drives.

    seconds: that the diagnosis took by the clock; cpu: s of CPU, nan where it is not known.
    """

    folder: Path
    truth: dict[str, Any]
    said: dict[str, Any] | None
    joint_of: Mapping[str, str]
    seconds: float
    cpu: float = math.nan

    @property
    def kind(self) -> str:
        return self.truth.get("kind") or ("null", "single", "double")[len(self.truth["effects"])]

    def named(self) -> list[dict[str, Any]]:
        """Effects of the verdict; of one that names none, an empty list."""
        return self.said["effects"] if self.said and self.said["verdict"] in ("effects", "ambiguous") else []

    def same(self, name: str, where: str, effect: Mapping[str, Any]) -> bool:
        """Whether a named effect at a place is the hidden one; actuators and their joints are one place."""
        if name != effect["name"]:
            return False
        at = self.joint_of.get(effect["where"], effect["where"])
        given = [self.joint_of.get(w, w) for w in where.replace("+", ",").split(",")]
        return at == "world" or at in given or (where == "all" and len(set(self.joint_of.values())) <= 1)

    def right(self, effect: Mapping[str, Any]) -> bool:
        return any(self.same(f["name"], str(f["where"]), effect) for f in self.named())

    def inside(self, effect: Mapping[str, Any]) -> bool:
        """Named, or not to be separated by these logs from what is named or from known parameters that are far off."""
        return any(self.same(*label, effect) for label in self.members())

    def members(self) -> list[tuple[str, str]]:
        """(effect, place) of the answer as a set: named, equal to it, hidden beside it, done by known parameters."""
        found = [(f["name"], str(f["where"])) for f in self.named()]
        found += [label for f in self.named() for entry in f.get("equivalent_to", ()) for label in labels_of(entry)]
        if self.said and (self.named() or self.said["verdict"] == "parameters"):
            others = [*self.said.get("hidden", ())]
            others += [x for p in self.said.get("parameters", {}).values() for x in p.get("same_as", ())]
            found += [label for entry in others for label in labels_of(entry)]
        return list(dict.fromkeys(found))


def labels_of(entry: Any) -> list[tuple[str, str]]:
    """ "effect@place" labels of an entry of equivalent_to, however it is written."""
    if isinstance(entry, str):
        name, _, where = entry.partition("@")
        return [(name, where)]
    if "effects" in entry:
        return [label for e in entry["effects"] for label in labels_of(e)]
    return [(entry["name"], str(entry.get("where", "")))]


def wilson(hits: int, n: int, z: float = Z95) -> tuple[float, float]:
    """Interval of a rate."""
    if not n:
        return 0.0, 1.0
    p, z2 = hits / n, z * z
    middle, half = p + z2 / (2 * n), z * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    return max((middle - half) / (1 + z2 / n), 0.0), min((middle + half) / (1 + z2 / n), 1.0)


def holds(given: Mapping[str, Any], truth: float) -> bool:
    """Whether what is said of a number holds: its 90 % interval, or "at least" and "at most" where a range ends.

    A number without a standard deviation that is no such limit holds nothing.
    """
    if side := ONE_SIDED.get(given.get("bound", "")):
        return side * (truth - given["mean"]) >= 0
    return bool(given["sd"]) and abs(given["mean"] - truth) <= Z90 * given["sd"]


def covered(outcome: Outcome) -> list[bool]:
    """Of the rightly named effects: whether what is said of each parameter with the same meaning holds."""
    found = []
    for effect in outcome.truth["effects"]:
        for f in outcome.named():
            if effect["name"] in LOOSE or not outcome.same(f["name"], str(f["where"]), effect):
                continue
            given = f.get("parameters", {})
            found += [holds(given[name], value) for name, value in effect["parameters"].items() if name in given]
    return found


def label(outcome: Outcome) -> str:
    """Name the first effect found, else the verdict."""
    if not outcome.said:
        return "no result"
    return outcome.named()[0]["name"] if outcome.named() else str(outcome.said["verdict"])


def alarm(outcome: Outcome) -> bool:
    """Whether something is said to be wrong besides parameters."""
    return label(outcome) not in ("no_gap", "parameters", "noise", "insufficient_data", "no result")


def rate(answers: Sequence[bool]) -> dict[str, float]:
    """{"hits", "n", "low", "high"}: a rate with its 95 % Wilson interval."""
    low, high = wilson(sum(answers), len(answers))
    return {"hits": sum(answers), "n": len(answers), "low": low, "high": high}
