"""Which models were tried and how well each predicts, as plain numbers: all that a decision rests on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Key = frozenset[str]  # labels of a model's effects
BASE: Key = frozenset()  # the known parameters alone


SPREADS = ("joint", "actuator")  # kinds of places of which a robot has one for each degree of freedom


@dataclass(frozen=True)
class Law:
    """One candidate: an effect at a place (or tied over all of them).

    Attributes:
        label: effect@where; numbers: free ones; index: entries of theta that it sets; special: effects it contains.
        kind: of its places: actuator, joint, body, geom or world; spread: a robot may have it at each of them.
    """

    label: str
    effect: str
    where: str
    numbers: int
    index: frozenset[int] = frozenset()
    special: tuple[str, ...] = ()
    kind: str = ""
    spread: bool = False

    def beside(self, other: Law) -> bool:
        """Whether both can be in one model: not the same numbers twice, nor a law beside its special case."""
        within = self.where == other.where and (self.effect in other.special or other.effect in self.special)
        return self.label != other.label and not self.index & other.index and not within


@dataclass(frozen=True, eq=False)
class Row:
    """One model.

    Attributes:
        key: labels of its effects; size: free numbers, those of the known parameters included.
        cost: `[W]`, squared whitened residuals of each held-out window.
        samples: effective number of independent residuals, of all windows together.
        distance: {label: standard deviations that its best told amplitude is away from neutral}.
        simulated: whether the cost was simulated fold by fold, not linearised.
        belief: log prior density, nats below its maximum, of what data sheets state of the effects.
    """

    key: Key
    size: int
    cost: Array
    samples: float
    distance: Mapping[str, float] = field(default_factory=dict)
    simulated: bool = False
    belief: float = 0.0

    @property
    def total(self) -> float:
        return float(self.cost.sum())


@dataclass(frozen=True, eq=False)
class Table:
    """All models tried on the same windows.

    Attributes:
        rows: by their effects; the known parameters alone (`BASE`) among them.
        laws: {label: candidate}.
        group: `[W]`, operating condition of each window.
        noise: expected cost of a window under a perfect model.
        believed: share of the noise (rms) that is the sensors'; the rest is what the time step may be worth at most.
        chance: `[draws]` nats that the best candidate gains in null logs (see `chance`), ascending.
        tolerated: `excess` up to which what is left is within the tolerance, at whatever joint it is.
    """

    rows: Mapping[Key, Row]
    laws: Mapping[str, Law]
    group: NDArray[np.int64]
    noise: float
    believed: float = 1.0
    chance: Array = field(default_factory=lambda: np.zeros(0))
    tolerated: float = 0.0

    @cached_property
    def samples(self) -> float:
        """Independent residuals of the model of least error, which stand for those of all where models are ranked."""
        return min(self.rows.values(), key=lambda r: r.total).samples

    @cached_property
    def reached(self) -> float:
        """Bound of the noise (rms, as a share of what was taken for it): what the best model leaves; 1 at most."""
        return float(min(1.0, *(np.sqrt(1.0 + self.excess(k)) for k in self.rows)))

    def excess(self, key: Key) -> float:
        """Held-out cost above the noise, as a multiple of the noise: squared gap that the model leaves."""
        return self.rows[key].total / (self.noise * len(self.group)) - 1.0

    def closed(self, key: Key) -> float:
        """Share of the known parameters' squared gap above the noise that a model closes, at most 1."""
        return 1.0 - max(self.excess(key), 0.0) / max(self.excess(BASE), 1e-9)

    def without(self, condition: int) -> Table:
        """The table of all other operating conditions."""
        kept = self.group != condition
        rows = {k: replace(r, cost=r.cost[kept], samples=r.samples * kept.mean()) for k, r in self.rows.items()}
        return replace(self, rows=rows, group=self.group[kept])

    def to_dict(self) -> dict[str, Any]:
        """For JSON; `read` is the way back."""
        return {
            "laws": [
                {"effect": c.effect, "where": c.where, "numbers": c.numbers, "index": sorted(c.index)}
                | ({"special": list(c.special)} if c.special else {})
                | ({"kind": c.kind} if c.kind else {})
                | ({"spread": True} if c.spread else {})
                for c in self.laws.values()
            ],
            "group": self.group.tolist(),
            "noise": self.noise,
            "believed": self.believed,
            "tolerated": float(f"{self.tolerated:.4g}"),
            "chance": [float(f"{c:.4g}") for c in self.chance],
            "rows": [
                {
                    "effects": sorted(r.key),
                    "size": r.size,
                    "cost": [float(f"{c:.6g}") for c in r.cost],
                    "samples": r.samples,
                    "distance": {k: float(f"{z:.4g}") for k, z in r.distance.items()},
                    "simulated": r.simulated,
                }
                | ({"belief": float(f"{r.belief:.4g}")} if r.belief else {})
                for r in self.rows.values()
            ],
        }


def read(raw: Mapping[str, Any]) -> Table:
    """A table from `Table.to_dict`."""
    laws = [
        Law(
            f"{c['effect']}@{c['where']}",
            c["effect"],
            c["where"],
            c["numbers"],
            frozenset(c["index"]),
            tuple(c.get("special", ())),
            c.get("kind", ""),
            c.get("spread", c.get("kind") in SPREADS),
        )
        for c in raw["laws"]
    ]
    rows = [
        Row(
            frozenset(r["effects"]),
            r["size"],
            np.array(r["cost"]),
            r["samples"],
            r["distance"],
            r["simulated"],
            r.get("belief", 0.0),
        )  # fmt: skip
        for r in raw["rows"]
    ]
    return Table(
        {r.key: r for r in rows},
        {c.label: c for c in laws},
        np.array(raw["group"], np.int64),
        raw["noise"],
        raw["believed"],
        np.array(raw.get("chance", ())),
        raw.get("tolerated", 0.0),
    )
