"""The benchmark's baselines against textbook formulas and a linear toy robot."""

from dataclasses import dataclass
from types import SimpleNamespace

import baselines
import lda
import numpy as np
import pytest
import worker
from families import FAMILIES, relatives, without

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection.models import Model

WINDOWS, SAMPLES, WIDE = 12, 10, 1e6
RNG = np.random.default_rng(0)
COLUMNS = RNG.normal(size=(WINDOWS, SAMPLES, 3))  # base parameter, first effect, second effect
STARTS = RNG.normal(size=(WINDOWS, SAMPLES, 1))
SPREAD = np.array([WIDE])


def coordinate(name: str, i: int) -> Coordinate:
    return Coordinate(name, (i,), 0.0, -WIDE, WIDE)


def model(r: np.ndarray, own: list[int]) -> Model:
    """A model at its least-squares fit, starts included."""
    A = COLUMNS[:, :, own]
    blocks = np.zeros((WINDOWS, SAMPLES, WINDOWS))
    for w in range(WINDOWS):
        blocks[w, :, w] = STARTS[w, :, 0]
    design = np.concatenate([A, blocks], 2).reshape(WINDOWS * SAMPLES, -1)
    x = np.linalg.lstsq(design, r.ravel(), rcond=None)[0]
    k = len(own)
    left = (r.ravel() - design @ x).reshape(r.shape)
    coordinates = tuple(coordinate(f"p{i}", i) for i in own)
    fit = Fit(coordinates, x[:k], x[k:, None], left, A, STARTS, np.ones(WINDOWS), float(np.sum(left**2)), spread=SPREAD)
    return Model((), fit, np.ones(WINDOWS), np.ones(WINDOWS), np.zeros((2, k)), 1.0)


def test_bic_is_schwarz_on_the_least_squares_residual():
    r = COLUMNS[:, :, 1] + 0.1 * RNG.normal(size=(WINDOWS, SAMPLES))
    small, right = model(r, [0]), model(r, [0, 1])
    n = r.size
    for m in (small, right):
        expected = n * np.log(np.sum(m.fit.r**2) / n) + m.size * np.log(n)
        assert baselines.bic(m) == pytest.approx(expected, rel=1e-6)
    assert baselines.bic(right) < baselines.bic(small)


def test_fold_error_is_that_of_least_squares_without_the_test_windows():
    r = COLUMNS[:, :, 1] + 0.1 * RNG.normal(size=(WINDOWS, SAMPLES))
    test = np.arange(WINDOWS) >= 8
    got = baselines.fold_error(model(r, [0, 1]), test)
    # outside of the start states, fitted on the first eight windows
    free = np.linalg.qr(STARTS)[0]
    out = lambda x: x - free @ (np.swapaxes(free, 1, 2) @ x)  # noqa: E731
    A, y = out(COLUMNS[:, :, :2]), out(r[..., None])[..., 0]
    p = np.linalg.lstsq(A[~test].reshape(-1, 2), y[~test].ravel(), rcond=None)[0]
    # the fit stays near that to all windows along directions that no data decide: TRUST
    assert got == pytest.approx(float(np.sum((y[test] - A[test] @ p) ** 2)), rel=2e-2)


@dataclass
class Line:
    """A robot whose gap is linear in its three numbers: what is measured less what is simulated."""

    def run(self, thetas: np.ndarray, offsets: np.ndarray, own: np.ndarray) -> np.ndarray:
        return (RECORDED[None, own] - np.einsum("wnk,mk->mwn", COLUMNS[own], thetas))[..., None]


RECORDED = np.zeros((WINDOWS, SAMPLES))


def toy(size: float) -> tuple[SimpleNamespace, Fit, list[Candidate]]:
    """Reality has `size` of the second effect; noise of 1."""
    RECORDED[:] = size * COLUMNS[:, :, 2] + np.random.default_rng(5).normal(size=RECORDED.shape)
    fitter = SimpleNamespace(
        simulator=Line(),
        whiten=lambda e: e[..., 0],
        vector=lambda c, v: np.bincount([x.index[0] for x in c], weights=v, minlength=3),
    )
    base = Coordinate("base", (0,), 0.0, -1.0, 1.0)
    blank = np.zeros((WINDOWS, 1))
    fit = Fit((base,), np.zeros(1), blank, RECORDED, COLUMNS[:, :, :1], STARTS, np.ones(WINDOWS), 0.0, spread=SPREAD)
    one = [Coordinate(n, (i,), 0.0, -20.0, 20.0) for i, n in ((1, "first"), (2, "second"))]
    return fitter, fit, [Candidate(c.name, "here", "joint", (c,), (False,)) for c in one]


@pytest.mark.parametrize(("size", "expected"), [(6.0, "second"), (-6.0, "second"), (0.0, None)])
def test_the_classifier_knows_a_direction_either_way_and_noise(size, expected):
    fitter, fit, candidates = toy(size)
    found = lda.classify(fitter, fit, candidates, np.random.default_rng(1))
    assert (found and found.effect) == expected


def test_drawn_values_stay_in_range_and_tell_their_largest():
    one_sided = Coordinate("level", (0,), 0.0, 0.0, 3.0)
    shape = Coordinate("speed", (1,), 0.1, 0.01, 1.0)
    candidate = Candidate("stribeck", "here", "joint", (one_sided, shape), (False, True))
    for seed in range(50):
        (level, speed), (largest, positive) = lda.draw(candidate, np.random.default_rng(seed))
        assert 0 < level <= 3.0 and 0.01 <= speed <= 1.0 and (largest, positive) == (0, True)


def test_every_effect_has_a_family_and_leaving_it_out_leaves_none_of_it():
    from bayessim_mjx.effects import names

    assert {e for family in FAMILIES for e in family} == set(names())
    for effect in names():
        left = set(without([effect], names()).split(","))
        assert effect in relatives([effect]) and not left & relatives([effect])
        assert left | relatives([effect]) == set(names())
    assert set(baselines.MEANS.values()) <= set(names())


def test_programs_traced_within_others_are_not_counted_twice():
    assert worker.covered([(5.0, 6.0), (0.0, 3.0), (1.0, 2.0), (2.5, 4.0)]) == pytest.approx(5.0)


def test_the_true_candidate_is_found_at_its_actuators_joint():
    fitter, _, candidates = toy(1.0)
    race = SimpleNamespace(candidates=candidates)
    found = baselines.candidate_of(race, "second", "motor", {"motor": "here"})
    assert found is candidates[1] and baselines.candidate_of(race, "second", "elsewhere", {}) is None
