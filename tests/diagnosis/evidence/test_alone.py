"""By how much an effect changes the motion, of columns that are written out."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence.weighing import alone
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit

MASS, LOAD, WIDTH = (Coordinate(name, (i,), 0.0, -9.0, 9.0, 1.0) for i, name in enumerate(("mass", "load", "width")))


def model(A, B):
    """One known parameter at .2 and an effect of size 3 and shape 5."""
    windows, n = A.shape[:2]
    fit = Fit((MASS, LOAD, WIDTH), np.array([0.2, 3.0, 5.0]), *(np.zeros(1),) * 5, 0.0)
    fit = replace(fit, r=np.zeros((windows, n)), A=A, B=B, offsets=np.zeros((windows, B.shape[2])))
    effect = SimpleNamespace(coordinates=(LOAD, WIDTH), shapes=(False, True))
    return SimpleNamespace(fit=fit, effects=(effect,))


def test_a_known_parameter_that_does_the_same_makes_it_no_smaller():
    A = np.random.default_rng(0).normal(size=(4, 10, 3))
    A[:, :, 0] = A[:, :, 1]
    assert alone(model(A, np.zeros((4, 10, 1))), np.ones(1)) == pytest.approx([9.0 * np.mean(A[:, :, 1] ** 2)])


def test_what_a_start_state_does_is_no_effect():
    A = np.random.default_rng(1).normal(size=(4, 10, 3))
    assert alone(model(A, A[:, :, 1:2].copy()), np.full(1, 1e4)) == pytest.approx([0.0], abs=1e-6)
