"""What the logs show of all entries: observations, actions and commands, and what the manifest expects of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.manifest import Entry, Manifest, Network
from bayessim_mjx.contract.recording import Run
from bayessim_mjx.contract.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Finding:
    """One thing that differs from the contract.

    Attributes:
        part: observation, action, command, clock or file. kind: what is wrong, a word of `words.SENTENCES`.
        entries: names; empty: all of the part. found, expected: numbers or words. before, left: error of the
            entries, or of the actions where no observation was logged, now and if this is mended, as a share of their
            variance; None where it is not known. each: {entry: (found, expected)} where entries share a finding.
    """

    part: str
    kind: str
    entries: tuple[str, ...] = ()
    found: float | str | None = None
    expected: float | str | None = None
    left: float | None = None
    before: float | None = None
    each: Mapping[str, tuple[float | str, float | str]] = field(default_factory=dict)


@dataclass
class Result:
    """All that a check found.

    Attributes:
        findings: what differs. untold: {entry: why it cannot be told}. compared: {part: entries that were compared and
            are as they should be}. notes: what else a user has to know.
    """

    findings: list[Finding] = field(default_factory=list)
    untold: dict[str, str] = field(default_factory=dict)
    compared: dict[str, list[str]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class Evidence:
    """Runs of one policy, with the answers of its file."""

    def __init__(self, runs: Sequence[Run], manifest: Manifest, network: Network) -> None:
        self.runs, self.manifest, self.network = runs, manifest, network

    @cached_property
    def seen(self) -> Array:
        """[N, S] observations as logged, all runs."""
        return np.concatenate([run.observation for run in self.runs])

    @cached_property
    def rebuilt(self) -> bool:
        """Whether no observation was logged, so that those of the manifest stand for them."""
        return not self.has("observation")

    @cached_property
    def given(self) -> list[Array]:
        """Observations [K, S] of each run: as logged, else as the manifest says by the logged state."""
        return [self.rebuild(run) if self.rebuilt else run.observation for run in self.runs]

    def rebuild(self, run: Run) -> Array:
        """[K, S] observations by the logged state and the previous actions; NaN where these were not logged."""
        before = shifted(self.fed(run), 1)
        before[0] = 0.0
        names, columns = self.manifest.actions, []
        for entry in self.manifest.observations:
            if entry.kind == "action":
                column: Array | None = entry.weight * before[:, names.index(entry.source[7:])] + entry.offset
            else:
                column = State(run, 0.0).entry(entry)
            columns.append(np.full(len(run.time), np.nan) if column is None else column)
        return np.stack(columns, 1)

    def fed(self, run: Run) -> Array:
        """[K, A] actions as logged, else those that the logged commands are made of."""
        if np.isfinite(run.action).any() or self.manifest.scale is None or self.manifest.offset is None:
            return run.action
        return (run.ctrl - self.manifest.offset) / self.manifest.scale

    @cached_property
    def answers(self) -> list[Array]:
        """Actions [K, A] of the file at the observations of each run."""
        return [self.network.run(observation) for observation in self.given]

    @cached_property
    def acted(self) -> list[Array]:
        """Actions [K, A] of each run: as logged, else the file's answers."""
        return [run.action for run in self.runs] if self.has("action") else self.answers

    def has(self, stream: str) -> bool:
        """Whether any run has `observation`, `action` or `ctrl`."""
        return any(np.isfinite(getattr(run, stream)).any() for run in self.runs)

    def reference(
        self, entries: Sequence[Entry], actions: Sequence[Array] | None = None
    ) -> Callable[[str, float], Array | None]:
        """Make the function (frame, steps of delay) -> [N, g] of what the manifest expects of entries.

        Args:
            actions: [K, A] of each run, which are fed back; default: as logged.
        """
        fed = self.acted if actions is None else actions

        def computed(frame: str, delay: float) -> Array | None:
            if frame and frame in _own_frames(entries):
                return None
            blocks = []
            for run, acted in zip(self.runs, fed, strict=True):
                columns = [self._entry(run, acted, entry, frame, delay) for entry in entries]
                found = [c for c in columns if c is not None]
                if len(found) < len(columns):
                    blocks.append(np.full((len(run.time), len(entries)), np.nan))
                else:
                    blocks.append(np.stack(found, 1))
            whole = np.concatenate(blocks)
            return whole if np.isfinite(whole).any() else None

        return computed

    def _entry(self, run: Run, acted: Array, entry: Entry, frame: str, delay: float) -> Array | None:
        if entry.terms and all(name.startswith("action:") for name in entry.terms):
            if frame or delay % 1:
                return None
            before = shifted(acted, 1 + int(delay))
            columns = [w * before[:, self.manifest.actions.index(n[7:])] for n, w in entry.terms.items()]
            return np.sum(columns, axis=0) + entry.offset
        return State(run, delay * run.period).entry(entry, frame)


def _own_frames(entries: Sequence[Entry]) -> tuple[str, ...]:
    """Frames that the manifest itself means."""
    kinds = {entry.kind for entry in entries}
    return ("world",) if any(kind.endswith("_world") for kind in kinds) else ("body",)


def shifted(values: Array, steps: int) -> Array:
    """[K, n] as they were `steps` before (negative: after); NaN beyond the ends."""
    out = np.full_like(values, np.nan, dtype=float)
    if steps == 0:
        return np.array(values, float)
    if abs(steps) >= len(values):
        return out
    if steps > 0:
        out[steps:] = values[:-steps]
    else:
        out[:steps] = values[-steps:]
    return out
