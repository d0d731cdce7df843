"""A search goes on with fits of its own code alone."""

import dataclasses
import warnings

import numpy as np
import pytest

from bayessim_mjx import versions
from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.setup import prepare
from tests.diagnosis.pendulums import nominal, recorded

ANEW = "made by other code than that which runs now; the search begins anew"


def found_in(folder, setup):
    """How much is on disk of two that are asked for: a beginning and a fit."""
    fitter = run.remembering(setup, folder).fitter
    fitter.iterate([fitter.begin((), np.zeros(0))], 1, lambda fit: [])
    return fitter.journal.found


def test_fits_of_other_sources_of_the_package_are_made_anew(tmp_path, monkeypatch):
    setup = prepare(nominal(tmp_path), recorded(count=3, seconds=1.0), Request(["viscous_friction"]))
    other = dataclasses.replace(setup, settings=dataclasses.replace(setup.settings, iterations=3))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert [found_in(tmp_path / "fits", setup) for _ in range(2)] == [0, 2]
    monkeypatch.setattr(versions, "sources", lambda: "edited")
    with pytest.warns(UserWarning, match=ANEW):
        assert found_in(tmp_path / "fits", setup) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert found_in(tmp_path / "fits", setup) == 2
        assert found_in(tmp_path / "fits", other) == 0  # another question: nothing is said of its code


def test_a_changed_file_of_the_sources_is_seen(tmp_path):
    folders = [tmp_path / name for name in ("one", "same", "edited", "moved")]
    for folder, name, text in zip(folders, ("a", "a", "a", "b"), ("x = 1", "x = 1", "x = 2", "x = 1"), strict=True):
        (folder / "room").mkdir(parents=True)
        (folder / "room" / f"{name}.py").write_text(text)
        (folder / "notes.txt").write_text(folder.name)  # no code
    one, same, edited, moved = map(versions.sources, folders)
    assert one == same and len({one, edited, moved}) == 3
