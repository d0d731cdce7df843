"""The folder of a diagnosis: what is known so far, the verdict as soon as it stands, and everything at the end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayessim_mjx.diagnosis import correction
from bayessim_mjx.diagnosis.experiment import command_file
from bayessim_mjx.diagnosis.experiment.propose import Experiment
from bayessim_mjx.diagnosis.findings import Findings, Observer, Progress
from bayessim_mjx.diagnosis.fitting import journal
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.result import Diagnosis, load
from bayessim_mjx.diagnosis.selection.tried import Tried
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.summary import assemble, preliminary

PRELIMINARY = "preliminary.json"  # what is known while the search goes on
SEARCH = "search_so_far"  # folder of what was fitted
COMMAND = "next_experiment.csv"


class Files(Observer):
    """Writes into a folder, or nowhere where there is none, and passes on what a diagnosis reports.

    Args:
        folder: made when there is something to write; about: what is diagnosed.
        progress, early: called as those of `Observer`; None: they are not.
    """

    def __init__(
        self,
        folder: Path | None,
        about: Mapping[str, Any],
        progress: Progress | None = None,
        early: Callable[[Sequence[str]], None] | None = None,
    ) -> None:
        self.folder, self.about = folder, about
        self._progress, self._early = progress, early

    def progress(self, text: str, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(text, done, total)

    def early(self, lines: Sequence[str]) -> None:
        if self._early is not None:
            self._early(lines)

    @property
    def search(self) -> Path | None:
        """Folder for what is fitted, from which a killed search goes on."""
        return None if self.folder is None else self.folder / SEARCH

    def known(self, setup: Setup, tried: Tried | None) -> None:
        """What is known before there is a verdict: killed there, this stays."""
        if self.folder is not None:
            preliminary.write(self.folder / PRELIMINARY, self.about, setup, tried)

    def verdict(self, found: Findings) -> None:
        """The verdict on its own: maps and the next experiment take time; killed there, it stays."""
        if self.folder is not None:
            assemble.diagnosis_of(found, self.about).save(self.folder)
            (self.folder / PRELIMINARY).unlink(missing_ok=True)
            journal.remove(self.folder / SEARCH)

    def result(self, found: Findings) -> Diagnosis:
        """What was found as a Diagnosis, its proposal as a file that can be played."""
        proposal, name = found.part(Experiment), ""
        if self.folder is not None and proposal is not None and proposal.chosen is not None:
            source = str(self.folder / "diagnosis.json")
            name = command_file.write_command(self.folder / COMMAND, proposal, source).name
        return assemble.diagnosis_of(found, self.about, name)

    def whole(self, result: Diagnosis, robot: Robot) -> Diagnosis:
        """Write everything but the report; returns what can be loaded again."""
        if self.folder is None:
            return result
        result.save(self.folder)  # before anything that could fail: nothing computed is lost
        result = load(self.folder)
        if result.verdict != "insufficient_data":
            left_out = correction.write_outputs(result, robot, self.folder)
            result = replace(result, warnings=[*result.warnings, *left_out])
            result.save(self.folder)
        return result
