"""Densities, levels and correlations of draws, and names that fit: by known answers."""

import numpy as np
import pytest

from bayessim_mjx.distributions.estimates import estimates
from bayessim_mjx.monitor.draws import density, density2, levels
from bayessim_mjx.monitor.tables import shorten

LONG = ["hand_robot0_forearm_joint_stiffness_mult", "index_finger_proximal_damping", "slider_mass_mult"]


def test_density_keeps_its_mass_at_the_border():
    values = np.abs(np.random.default_rng(0).normal(0, 0.2, 20_000))  # half normal: densest at 0
    x, y = density(values, 0.0, 2.0)
    assert np.isclose((y * (x[1] - x[0])).sum(), 1.0)
    assert abs(y[0] - 2 / (0.2 * np.sqrt(2 * np.pi))) < 0.3


def test_levels_hold_the_mass_they_say():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 40_000))
    *_, height = density2(x, y, (-4, 4, -4, 4), 100)
    for level, mass in zip(levels(height, (0.9, 0.5)), (0.9, 0.5), strict=True):
        assert abs(height[height >= level].sum() - mass) < 0.02
    r = 1.18  # radius with half of a standard normal in the plane
    inside = height >= levels(height, (0.5,))[0]
    assert abs(inside.sum() * 0.08**2 - np.pi * r**2) < 0.4


def test_correlations_of_known_vectors():
    x = np.random.default_rng(0).normal(size=1000)
    matrix = estimates(np.stack([x, -2 * x, np.ones(1000)], 1), np.ones(3)).correlation
    np.testing.assert_allclose(matrix, [[1, -1, 0], [-1, 1, 0], [0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize("width,lines", [(8, 1), (12, 2), (10, 3)])
def test_short_names_fit_and_stay_different(width, lines):
    names = LONG + [f"left_front_leg_{i}_friction_mult" for i in range(12)]
    short = shorten(names, width, lines)
    assert len(set(short)) == len(names)
    for name in short:
        assert len(name.split("\n")) <= lines and max(map(len, name.split("\n"))) <= width
    assert shorten(["mass", "length"], 8) == ["mass", "length"]


def test_names_are_broken_between_words():
    for rows in (name.split("\n") for name in shorten(LONG, 13, 3)):
        assert all(row.endswith(("_", "…")) for row in rows[:-1]), rows
