"""Friction and softness of contacts: balls that slide and fall on a floor, against MuJoCo C and by hand."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError
from tests.effects.truths import edited, moved, physics, recovered, truth

BALL = """
    <body name="{0}" pos="0 {1} .1">
      <joint name="{0}x" type="slide" axis="1 0 0"/><joint name="{0}z" type="slide" axis="0 0 1"/>
      <geom name="{0}" size=".1" mass="1" {2}/><geom name="{0}_shown" size=".05" contype="0" conaffinity="0" mass="0"/>
    </body>"""
XML = f"""
<mujoco>
  <option timestep=".002"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".2"/>
    {BALL.format("a", 0, 'friction=".4" solref=".03 1"')}
    {BALL.format("b", 1, 'contype="0" conaffinity="0"')}
  </worldbody>
  <contact><pair geom1="floor" geom2="b" friction=".3 .3" solref=".04 1"/></contact>
</mujoco>
"""
NOTHING = np.zeros((30, 0))
SLIDING = np.array([2.0, 0, 2.0, 0])
GEOMS = ("a", "b")
NEUTRAL = [1.0, 1.0, 0.0, 0.0]  # scale of a, of b, softness of a, of b
ROWS = 8
FALLING = np.array([0, 0.05, 0, 0.05])


def stack():
    return [make("contact_friction", where=GEOMS), make("contact_compliance", where=GEOMS)]


WORLD = physics(XML, stack())


def run(thetas, qpos=None, qvel=None):
    full = [*thetas, *[NEUTRAL] * (ROWS - len(thetas))]
    return moved(WORLD, full, NOTHING, qpos, qvel)[: len(thetas)]


def plain(qpos=None, qvel=None, values=None, name=None):
    model = edited(XML, make(name, where=GEOMS), values) if values else mujoco.MjModel.from_xml_string(XML)
    return truth(model, NOTHING, qpos, qvel)


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_changes_no_bit_also_beside_another_effect():
    drag = make("viscous_friction", where="ax")
    alone = moved(physics(XML, [drag]), [[0.5]], NOTHING, FALLING, SLIDING)
    beside = moved(physics(XML, [drag, *stack()]), [[0.5, *NEUTRAL]], NOTHING, FALLING, SLIDING)
    np.testing.assert_array_equal(beside, alone)


@pytest.mark.slow
def test_friction_brakes_by_mu_g():
    """v^2 / 2 mu g to the stop; the pair of b with its own coefficient."""
    scales = ((1.0, 1.0), (1.5, 2.0), (2.5, 3.0))
    q = run([[*s, 0, 0] for s in scales], qvel=SLIDING)
    for row, (a, b) in zip(q, scales, strict=True):
        for column, mu in ((0, 0.4 * a), (2, 0.3 * b)):
            t = min(0.6, 2.0 / (mu * 9.81))
            assert row[-1, column] == pytest.approx(2.0 * t - mu * 9.81 * t * t / 2, rel=0.03)


def test_friction_is_that_of_the_edited_model():
    values = {"a": {"scale": 2.0}, "b": {"scale": 0.5}}
    real = plain(qvel=SLIDING, values=values, name="contact_friction")
    (q,) = run([[2.0, 0.5, 0, 0]], qvel=SLIDING)
    np.testing.assert_allclose(q, real, atol=2e-3)
    assert np.abs(real - plain(qvel=SLIDING)).max() > 0.1


def test_compliance_is_that_of_the_edited_model():
    values = {"a": {"softness": 1.0}, "b": {"softness": 0.7}}
    real = plain(FALLING, values=values, name="contact_compliance")
    (q,) = run([[1, 1, 1.0, 0.7]], FALLING)
    np.testing.assert_allclose(q, real, atol=1e-3)
    assert np.abs(real - plain(FALLING)).max() > 5e-3


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "wanted", "start"), [([0, 1], [1.7, 0.6], SLIDING), ([2, 3], [0.8, 0.5], None)])
def test_recovers_what_mujoco_was_given(columns, wanted, start):
    name, quantity = (("contact_friction", "scale"), ("contact_compliance", "softness"))[columns[0] == 2]
    qpos = None if start is not None else FALLING
    real = plain(qpos, start, {g: {quantity: w} for g, w in zip(GEOMS, wanted, strict=True)}, name)

    def simulate(points):
        full = np.tile(NEUTRAL, (len(points), 1))
        full[:, columns] = points
        return run(full, qpos, start)

    neutral = np.asarray(NEUTRAL)[columns]
    found = recovered(simulate, real, 0.9 * neutral + 0.1 * np.asarray(wanted), [1.0, 1.0], ROWS)
    np.testing.assert_allclose(found, wanted, rtol=0.04)


@pytest.mark.slow
@pytest.mark.ci
def test_two_places_are_two_single_effects_and_all_is_tied():
    singles = [make(name, where=g) for name in ("contact_friction", "contact_compliance") for g in GEOMS]
    (q,) = run([[1.5, 0.5, 0.4, -0.4]], FALLING, SLIDING)
    apart = moved(physics(XML, singles), [[1.5, 0.5, 0.4, -0.4]], NOTHING, FALLING, SLIDING)[0]
    np.testing.assert_allclose(q, apart, atol=1e-6)
    everywhere = physics(XML, [make("contact_friction", where="all")])
    assert everywhere.sites[0].names == ("floor", "a", "b")
    tied = moved(everywhere, [[1.5]], NOTHING, None, SLIDING)[0]
    (q,) = run([[1.5, 2.25, 0, 0]], qvel=SLIDING)  # of the pair: both geoms
    np.testing.assert_allclose(tied, q, atol=1e-5)


def test_refusals():
    with pytest.raises(UserError, match="'a_shown' collides with nothing; allowed: floor, a, b"):
        physics(XML, [make("contact_friction", where="a_shown")])
    with pytest.raises(UserError, match="solref -100 -10; allowed"):
        physics(XML.replace(".03 1", "-100 -10"), [make("contact_compliance", where="a")])
