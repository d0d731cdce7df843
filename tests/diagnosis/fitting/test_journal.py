"""A killed search goes on: what was fitted is read, in every bit, and what was asked in other words is fitted anew."""

import dataclasses

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.fitting.journal import ABOUT, Journal, Remembering, digest, remove
from tests.diagnosis.selection.test_bounds import pool_of


def fits_of(folder, start=0.5, about="this", code="code"):
    """(what a toy search comes to, calls of its simulator, fits that were on disk)."""
    pool, model = pool_of(0.4, start=start)
    journal = Journal(folder, about, code)
    fitter = Remembering(pool.fitter, journal)
    calls, run = [], fitter.simulator.run
    fitter.simulator.run = lambda *args: calls.append(1) or run(*args)
    fit = fitter.begin(model.fit.coordinates, np.array([start]))
    fits = fitter.iterate([fit, fit], 6, lambda f: [0])
    return [fit, *fits, fitter.refresh(fits[0])], len(calls), journal.found


def same(a: Fit, b: Fit) -> bool:
    pairs = ((getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(Fit))
    return all(np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in pairs)


def test_what_was_fitted_is_read_in_every_bit(tmp_path):
    first, calls, found = fits_of(tmp_path)
    again, none, all_of_it = fits_of(tmp_path)
    assert calls > 0 == found and none == 0 and all_of_it == 3
    assert all(same(a, b) for a, b in zip(first, again, strict=True))


def test_a_search_that_was_killed_goes_on_where_it_was(tmp_path):
    whole, calls, _ = fits_of(tmp_path / "whole")
    fits_of(tmp_path / "killed")
    (tmp_path / "killed" / "00002.npz").write_bytes(b"half a file")
    rest, fewer, found = fits_of(tmp_path / "killed")
    assert found == 2 and 0 < fewer < calls and all(same(a, b) for a, b in zip(whole, rest, strict=True))


def test_other_questions_find_nothing(tmp_path):
    fits_of(tmp_path)
    assert fits_of(tmp_path, start=0.6)[2] == 0  # other fits are asked for
    assert fits_of(tmp_path, start=0.6, about="other logs")[2] == 0
    assert fits_of(tmp_path, start=0.6, about="other logs")[2] == 3


def test_fits_of_other_code_are_not_used(tmp_path):
    fits_of(tmp_path)
    with pytest.warns(UserWarning, match="made by other code than that which runs now; the search begins anew"):
        assert fits_of(tmp_path, code="other code")[2] == 0
    assert fits_of(tmp_path, code="other code")[2] == 3


def test_it_is_removed_and_nothing_else(tmp_path):
    fits_of(tmp_path / "search")
    (tmp_path / "search" / "notes.txt").write_text("mine")
    remove(tmp_path / "search")
    assert [p.name for p in (tmp_path / "search").iterdir()] == ["notes.txt"]
    (tmp_path / "search" / "notes.txt").unlink()
    remove(tmp_path / "search")  # no journal: nothing of it is touched
    assert (tmp_path / "search").is_dir() and not (tmp_path / "search" / ABOUT).exists()
    remove(tmp_path / "nowhere")


@pytest.mark.parametrize("other", [np.arange(3) + 1, "text"])
def test_digests_tell_things_apart(other):
    assert digest(np.arange(3), "a") == digest(np.arange(3), "a") != digest(other, "a")
