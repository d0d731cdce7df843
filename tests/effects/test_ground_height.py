"""Ground that is higher or lower: against MuJoCo C with a plane that is moved, and by hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.effects.ground_height import ground
from bayessim_mjx.errors import UserError
from tests.effects.truths import edited, moved, physics, recovered, truth

# two feet, over a floor and over a step in a turned frame; a base with a shell of its own that carries the legs
XML = """
<mujoco>
  <option timestep=".002"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <geom name="painted" type="plane" size="5 5 .1" pos="0 0 .001" contype="0" conaffinity="0"/>
    <body name="stairs" pos="1 0 0" euler="90 0 0">
      <geom name="step" type="box" size=".3 .05 .3" pos="0 .1 0"/>
    </body>
    <body name="base" pos="0 3 1">
      <geom name="shell" size=".1"/>
      <body pos="0 -3 -.8"><joint name="a" type="slide" axis="0 0 1"/><geom name="foot_a" size=".1" mass="1"/></body>
      <body pos="1 -3 -.6"><joint name="b" type="slide" axis="0 0 1"/><geom name="foot_b" size=".1" mass="1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
NOTHING = np.zeros((30, 0))
WORLD = physics(XML, [make("ground_height", where="world")])
ROWS = 4
OPEN = "<mujoco><worldbody>{}<body><joint type='slide'/><geom size='.1'/></body></worldbody></mujoco>"


def run(heights):
    return moved(WORLD, [[h] for h in [*heights, *[0.0] * (ROWS - len(heights))]], NOTHING)[: len(heights)]


def test_what_is_ground():
    model = mujoco.MjModel.from_xml_string(XML)
    assert [model.geom(i).name for i in ground(model)] == ["floor", "step"]


@pytest.mark.slow
@pytest.mark.ci
def test_falls_on_the_moved_ground_as_in_mujoco():
    heights = [-0.03, 0.0, 0.04]
    effect = make("ground_height", where="world")
    for q, height in zip(run(heights), heights, strict=True):
        model = edited(XML, effect, {"world": {"height": height}})
        assert model.geom("floor").pos[2] == pytest.approx(height)
        np.testing.assert_allclose(q, truth(model, NOTHING), atol=1e-3)


def test_comes_to_rest_as_much_higher():
    low, high = run([-0.02, 0.03])
    np.testing.assert_allclose(high[-1] - low[-1], 0.05, atol=1e-3)
    np.testing.assert_allclose(low[-1] + [0.1, 0.15], [-0.02, -0.02], atol=5e-3)  # a touches at -.1, b at -.15


def test_neutral_changes_no_bit_of_the_model():
    (effect,), (at,) = WORLD.effects, WORLD.sites
    before, after = WORLD.model, effect.on_model(at, WORLD.model, jnp.zeros(1))
    for one, two in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.slow
@pytest.mark.ci
def test_recovers_what_mujoco_was_given():
    real = truth(edited(XML, make("ground_height", where="world"), {"world": {"height": 0.023}}), NOTHING)
    found = recovered(lambda points: run(points[:, 0]), real, [0.0], [0.01], ROWS)
    np.testing.assert_allclose(found, [0.023], atol=5e-4)


@pytest.mark.parametrize("scene", ["", "<geom type='plane' size='1 1 1' contype='0' conaffinity='0'/>"])
def test_refuses_models_without_ground(scene):
    with pytest.raises(UserError, match="nothing that stands still"):
        physics(OPEN.format(scene), [make("ground_height", where="world")])
