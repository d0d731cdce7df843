"""The result of a diagnosis: plain dataclasses of numbers and words, to and from JSON. The report renders them."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.diagnosis import correction
from bayessim_mjx.diagnosis.correction import Estimate, FoundEffect
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics

SCHEMA = 1


class Verdict(StrEnum):
    """One of seven verdicts; it is a string, its code. `words` is its title in reports, on the terminal and in docs."""

    words: str

    def __new__(cls, code: str, words: str = "") -> Verdict:
        """Find the member of a code."""
        member = str.__new__(cls, code)
        member._value_, member.words = code, words
        return member

    NO_GAP = "no_gap", "No gap"
    PARAMETERS = "parameters", "Parameters only"
    NOISE = "noise", "Noise larger than estimated"
    EFFECTS = "effects", "Missing effects found"
    AMBIGUOUS = "ambiguous", "Ambiguous"
    UNEXPLAINED = "unexplained", "Unexplained"
    INSUFFICIENT_DATA = "insufficient_data", "Too little data"


VERDICTS = tuple(Verdict)


@dataclass(frozen=True)
class Place:
    """Where the gap lies: a channel (joint, actuator, sensor, link of the chain), its share, and in which region."""

    channel: str
    share: float
    ci: tuple[float, float]
    region: str
    kind: str = "joint"


@dataclass(frozen=True)
class Gap:
    """Root mean square of measured minus simulated motion on held-out windows, in units of the measurement noise.

    A window has half a second, at least 8 and at most 100 control steps (`fitting.cutting.CUTTING`). With contacts it
    is halved, twice at most, until the error of the time step is below 5 noises. Each window's start
    state is fitted to it, within the noise of the sensors. *Stages* are the keys `nominal`, `calibrated`,
    `with_effects`, `reducible_floor` and `noise_floor`.

    Attributes:
        noise_floor: 1, the noise itself.
        nominal, calibrated, with_effects: the simulator as delivered, recalibrated, and with the effects found.
        reducible_floor: the least of any model: the difference of runs with the same commands, or the noise.
        unit: of all of them.
        by_channel: {joint: {stage: value}}.
        horizons: [{"name": "0.25 s", "seconds", each stage, "floor": "noise", "repeats" or "start" (of a long
            simulation), "ci": {stage: [low, high]} (90 %), "physical", "shares"}], the window's and others. That of
            whole logs has "over_likely" (rms error over the likely one) and "in_sample": the number of logs that are
            simulated with parameters that were fitted to them.
        physical: {joint: {stage: rad or m, "unit", "noise", "motion": range of the logged motion, "tolerance",
            "largest": error of the last stage, "beyond": whether more than the tolerance remains}}.
        shares: {stage: share of the range of motion, rms over the joints}.
        beyond: joints where more than the tolerance remains.
        closed: {"predicted", "realised", "ci", "nested", "elsewhere"}: share of the recalibrated simulator's squared
            gap above the noise that all effects close. `predicted`: by one linear step before any fit. `realised`: on
            windows whose condition the fit had not seen, with its 90 % interval `ci`. `nested`: whether the effects
            were chosen without that condition too (from three conditions on). `elsewhere`: where only the choice was
            made without it. Both are biased upwards a little: the fits that the choice compares had seen every
            condition.
        integrator: error of the simulator's own time step (`discretisation.Discretisation.to_dict`).
        coasting: the gap without any simulator, every joint keeping its speed; None: not known.
        in_sample: whether there is one log only, of which parts are held out.
    """

    noise_floor: float
    nominal: float
    calibrated: float
    with_effects: float
    reducible_floor: float
    unit: str = "noise standard deviations"
    by_channel: dict[str, dict[str, float]] = field(default_factory=dict)
    horizons: list[dict[str, Any]] = field(default_factory=list)
    physical: dict[str, dict[str, Any]] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    beyond: list[str] = field(default_factory=list)
    closed: dict[str, Any] = field(default_factory=dict)
    integrator: dict[str, Any] = field(default_factory=dict)
    coasting: float | None = None
    in_sample: bool = False


@dataclass(frozen=True)
class Diagnosis:
    """The whole result.

    Attributes:
        verdict: a `Verdict`, or its code; sentences: the verdict in words, most important first.
        parameters: {name: {"mean", "sd", "nominal", "low", "high", "unit", "structural": sentence or "", "at_bound",
            "data_sheet": sentence or "", "away": sd from the data sheet, where that is far,
            "simulated": value that fits at the simulator's time step; "mean" is the robot's,
            "same_as": effects ("name@place") that its deviation from the data sheet may stand for}}.
        candidates: ranked [{"effects": [label ...], "label", "score", "se", "gap_closed", "parameters": {..},
            "absorbed"}].
        covariance: {"names": [...], "matrix": [[...]]} of parameters and effects' parameters together, or {}.
        not_fitted: {reason: effects ("name@place") that were not fitted, and so not ruled out}.
        about: {"robot", "data": [paths], "logs", "seconds", "conditions", "date", "seed"}, what was diagnosed, or {}.
        hidden: effects ("name@place") that would not show beside those that are named, whose parameters do the same.
        accuracy: {kind of parameter: {"median", "low", "high", "parameters"}}: the inferred accuracy of the model's
            numbers as a share, its 90 % interval, and how many numbers; of kinds whose accuracy nobody stated.
        evidence: sets of effects, most likely first: [{"effects": [label ...], "probability", "nats" of evidence and
            prior over the known parameters alone}].
        answers: of each effect {"effect": label, "members": [{"effects": [label ...], "probability"}], the explanations
            that these logs do not separate, the named one first, "number": `FoundEffect.shared`, "splits": name of the
            experiment that separates them, or ""}.
        basis: numbers behind the sentences: {"window": s, "remains": share of the squared gap that is made by a force
            missing beside the effects, posterior mean (0: it is not probable that it is relevant), "noise_memory": s
            of the sensors' noise, or None, "far_off": (known parameters far off, of so many), "builds_up": times the
            likely error over whole logs, "above_noise": whether recalibration leaves more than noise, "probability":
            {"answer", "rivals", "nothing"}, "flexible": `phrases.residual.flexible_of`, "efforts": clause on the
            logged efforts, "tried": names of effects, "not_tried": {"minutes", "before", "parts"}}.
        next_experiment: {"name", "why", "evidence", "file", "table": [...]} or {}.
        details: numbers for pictures (see `report`); not part of diagnosis.json but saved beside it.
    """

    verdict: str
    sentences: list[str]
    effects: list[FoundEffect]
    where: list[Place]
    gap: Gap
    parameters: dict[str, dict[str, Any]]
    candidates: list[dict[str, Any]]
    warnings: list[str]
    next_experiment: dict[str, Any]
    versions: dict[str, str]
    details: dict[str, Any] = field(default_factory=dict)
    covariance: dict[str, Any] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    not_fitted: dict[str, list[str]] = field(default_factory=dict)
    hidden: list[str] = field(default_factory=list)
    accuracy: dict[str, dict[str, float]] = field(default_factory=dict)
    evidence: list[dict[str, Any]] = field(default_factory=list)
    answers: list[dict[str, Any]] = field(default_factory=list)
    basis: dict[str, Any] = field(default_factory=dict)
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        object.__setattr__(self, "verdict", Verdict(self.verdict))

    @property
    def rank(self) -> int | None:
        """Rank of the named effects among the candidates, from 1; None where none is named."""
        named = {f"{e.name}@{e.where}" for e in self.effects}
        ranks = [k for k, c in enumerate(self.candidates, 1) if named and set(c.get("effects") or []) == named]
        return ranks[0] if ranks else None

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of diagnosis.json; numbers that are not finite become null."""
        out = {"schema": self.schema} | {
            f.name: plain(getattr(self, f.name))
            for f in dataclasses.fields(self)
            if f.name not in ("details", "schema")
        }
        return out

    def apply(self, physics: Physics) -> Physics:
        """Return the corrected simulator, see `correction.apply`."""
        return correction.apply(self, physics)

    def prior(self, physics: Physics | ParameterSpace | None = None) -> Distribution:
        """Return the distribution of the corrected simulator's theta, for the loop; see `correction.prior`."""
        return correction.prior(self, physics)

    def save(self, folder: str | Path) -> Path:
        """Write diagnosis.json and details.json into `folder`; returns the former's path."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "diagnosis.json"
        atomic.write_text(path, json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n")
        atomic.write_text(folder / "details.json", json.dumps(plain(self.details), allow_nan=False))
        return path


def load(folder: str | Path) -> Diagnosis:
    """Return a saved diagnosis; what was not finite is NaN again."""
    folder = Path(folder)
    raw: dict[str, Any] = json.loads((folder / "diagnosis.json").read_text())
    details = folder / "details.json"
    raw["details"] = json.loads(details.read_text()) if details.is_file() else {}
    raw["effects"] = [_effect(e) for e in raw["effects"]]
    raw["where"] = [Place(**{**p, "ci": _ends(p["ci"])}) for p in raw["where"]]
    raw["gap"] = Gap(**_numbers(raw["gap"]))
    return Diagnosis(**raw)


def _effect(raw: dict[str, Any]) -> FoundEffect:
    parameters = {k: Estimate(**_numbers(v)) for k, v in raw["parameters"].items()}
    rest = _numbers({k: v for k, v in raw.items() if k != "parameters"})
    if "probability" in rest:  # its name in files of before
        weight = rest.pop("probability")
        rest["weight_among_rivals"] = weight if rest["equivalent_to"] else math.nan
    return FoundEffect(**{**rest, "parameters": parameters, "gap_closed_ci": _ends(raw["gap_closed_ci"])})


def _ends(raw: list[float | None]) -> tuple[float, float]:
    low, high = (math.nan if v is None else v for v in raw)
    return low, high


def _numbers(raw: dict[str, Any]) -> dict[str, Any]:
    return {k: math.nan if v is None else v for k, v in raw.items()}


def plain(value: Any) -> Any:
    """Dataclasses, arrays and numpy numbers as JSON values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
