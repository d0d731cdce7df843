"""Drag and wind that the finer reality hides are those of the library, with the parameters that it states."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.blind.reality.menu import CAUSES
from tests.effects.test_floating_bodies import resistance

QUAT = np.array([0.8, 0.2, -0.4, 0.4])


@pytest.mark.parametrize("name", ["body_drag", "directional_drag", "wind"])
def test_the_cause_is_the_librarys_law(name):
    scales = SimpleNamespace(mass={"drone": 0.8})
    for seed in range(4):
        cause = CAUSES[name]("drone", scales, np.random.default_rng(seed), size=0.4)
        own = cause.parameters()
        medium = [own.get(f"wind_{a}", 0.0) for a in "xyz"]
        qvel = [1, 2, -1, 3, -2, 1, 0.7]
        drag, axes = [own[n] for n in ("linear", "quadratic", "turning")], [1, own.get("side", 1), own.get("up", 1)]
        force, model, data = resistance(qvel, drag, medium, quat=QUAT, axes=axes)
        cause.force(SimpleNamespace(model=model, data=data))
        expected = np.zeros(model.nv)
        push = data.xfrc_applied[1]
        mujoco.mj_applyFT(model, data, push[:3], push[3:], data.xipos[1], 1, expected)
        np.testing.assert_allclose(force, expected, atol=2e-5)
        assert np.abs(expected[:3]).min() > 0.01 and (name == "wind") == any(medium)
        assert (name == "directional_drag") == (axes != [1, 1, 1])
