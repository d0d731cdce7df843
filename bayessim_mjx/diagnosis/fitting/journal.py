"""Fits on disk in the order in which they were made, so that a killed search goes on where it was.

A search is deterministic: the same logs, model and settings ask for the same fits in the same order. The n-th thing
that is asked for is looked up in the n-th file, if it was asked in the same words; from the first other one on, what is
there is stale.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter

ARRAYS = ("values", "offsets", "r", "A", "B", "weight", "reach", "spread")
NUMBERS = ("cost", "damping", "promise", "doubt")
ABOUT = "about.txt"
FILES = "[0-9][0-9][0-9][0-9][0-9].npz"


class Journal:
    """Fits in a folder.

    Args:
        folder: made where it is not there; what is in it of another search is removed.
        about: what is searched, a digest.
        code: what searches, a digest. Fits of other code are never mixed with new ones; a warning says that they go.
    """

    def __init__(self, folder: Path, about: str, code: str) -> None:
        self.folder, self.count, self.found = folder, 0, 0
        folder.mkdir(parents=True, exist_ok=True)
        path, own = folder / ABOUT, f"{about}\n{code}\n"
        old = path.read_text() if path.is_file() else None
        if old == own:
            return
        if old is not None and old.split("\n")[0] == about and any(folder.glob(FILES)):
            text = f"{folder}: the fits in it were made by other code than that which runs now; the search begins anew"
            warnings.warn(text, stacklevel=3)
        self._forget()
        atomic.write_text(path, own)

    def play(self, asked: str, fit: Callable[[], list[Fit]]) -> list[Fit]:
        """Return a result as it is on disk, else as `fit` gives it, which is then on disk."""
        path = self.folder / f"{self.count:05d}.npz"
        self.count += 1
        known = _read(path, asked)
        if known is not None:
            self.found += 1
            return known
        self._forget(self.count - 1)
        fits = fit()
        _write(path, asked, fits)
        return fits

    def _forget(self, first: int = 0) -> None:
        for path in self.folder.glob(FILES):
            if int(path.stem) >= first:
                path.unlink()


def remove(folder: Path) -> None:
    """Return the journal in a folder, and the folder where nothing else is in it."""
    if not (folder / ABOUT).is_file():
        return
    for path in (*folder.glob(FILES), *folder.glob("*.tmp"), folder / ABOUT):
        path.unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


class Remembering(Fitter):
    """A fitter whose fits are in a journal, until that is None.

    Args:
        bare: what it comes to goes without residuals and columns, which are by far the most of it.
    """

    def __init__(self, fitter: Fitter, journal: Journal, bare: bool = False) -> None:
        super().__init__(fitter.simulator, fitter.base, fitter.theta)
        self.journal: Journal | None = journal
        self.bare = bare

    def refresh(self, fit: Fit) -> Fit:
        """As of `Fitter`."""
        if self.journal is None:
            return super().refresh(fit)
        (new,) = self.journal.play(_asked("refresh", [fit]), lambda: [super(Remembering, self).refresh(fit)])
        return new

    def iterate(self, fits: Sequence[Fit], iterations: int, *args: Any, **options: Any) -> list[Fit]:
        """As of `Fitter`."""
        if self.journal is None:
            return super().iterate(fits, iterations, *args, **options)
        asked = _asked(f"iterate {iterations}", fits)

        def fitted() -> list[Fit]:
            found = super(Remembering, self).iterate(fits, iterations, *args, **options)
            none = np.empty(0)
            return [dataclasses.replace(fit, r=none, A=none, B=none) for fit in found] if self.bare else found

        return self.journal.play(asked, fitted)


def digest(*parts: Any) -> str:
    """Of arrays, by their bytes, and of anything else, by what it says of itself."""
    total = hashlib.sha256()
    for part in parts:
        own = (
            part.tobytes() if isinstance(part, np.ndarray) else part if isinstance(part, bytes) else repr(part).encode()
        )
        total.update(hashlib.sha256(own).digest())
    return total.hexdigest()


def _asked(what: str, fits: Sequence[Fit]) -> str:
    each = [part for f in fits for part in (f.coordinates, f.values, f.offsets, f.cost, f.history, f.damping)]
    return digest(what, *each)


def _write(path: Path, asked: str, fits: Sequence[Fit]) -> None:
    """Whole or not at all; arrays that fits share are there once."""
    arrays: dict[str, Any] = {}
    places: dict[int, str] = {}
    each = []
    for fit in fits:
        own: dict[str, Any] = {name: float(getattr(fit, name)) for name in NUMBERS}
        own |= {
            "history": list(map(float, fit.history)),
            "coordinates": [dataclasses.asdict(c) for c in fit.coordinates],
        }
        for name in ARRAYS:
            value = getattr(fit, name)
            place = places.setdefault(id(value), f"a{len(places)}")
            arrays[place] = value
            own[name] = place
        each.append(own)
    text = json.dumps({"asked": asked, "fits": each})
    with atomic.replacing(path) as file:
        np.savez(file, about=np.array(text), **arrays)


def _read(path: Path, asked: str) -> list[Fit] | None:
    """Return the fits of a file that was written for this; None where there is none, or a damaged one."""
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            if about["asked"] != asked:
                return None
            arrays = {name: file[name] for name in file.files if name != "about"}
        return [_fit(own, arrays) for own in about["fits"]]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _fit(own: dict[str, Any], arrays: dict[str, Any]) -> Fit:
    coordinates = tuple(Coordinate(**{**c, "index": tuple(c["index"])}) for c in own["coordinates"])
    parts = {name: arrays[own[name]] for name in ARRAYS} | {name: own[name] for name in NUMBERS}
    return Fit(coordinates=coordinates, history=tuple(own["history"]), **parts)
