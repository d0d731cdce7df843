"""Rotations as vectors: exact at any angle, with derivatives where there is no rotation at all."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.physics.tangent import difference, integrate

BALL = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint type="ball"/><geom size=".1"/></body></worldbody></mujoco>'
)
AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def turned(quat: np.ndarray, by: np.ndarray) -> np.ndarray:
    """By MuJoCo itself."""
    out = quat.copy()
    mujoco.mj_integratePos(BALL, out, by, 1.0)
    return out


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 1.9e-3, 2.1e-3, 0.1, 1.0, 3.0, 3.1, -3.1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rotation_of_any_angle_is_its_vector(angle: float, sign: float):
    begin = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
    end = turned(begin, angle * AXIS)
    found = difference(BALL, jnp.asarray(sign * end), jnp.asarray(begin))  # both signs are one orientation
    np.testing.assert_allclose(found, angle * AXIS, rtol=2e-5, atol=3e-7)
    np.testing.assert_allclose(integrate(BALL, jnp.asarray(begin), jnp.asarray(angle * AXIS)), end, atol=5e-7)


def test_more_than_half_a_turn_is_the_shorter_way_round():
    begin = np.array([1.0, 0, 0, 0])
    found = difference(BALL, jnp.asarray(turned(begin, 3.5 * AXIS)), jnp.asarray(begin))
    np.testing.assert_allclose(found, (3.5 - 2 * np.pi) * AXIS, rtol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-3, 1.0, 3.0])
def test_the_derivative_of_there_and_back_is_one_also_where_nothing_turns(angle: float):
    begin = jnp.array([1.0, 0, 0, 0])
    there = lambda x: difference(BALL, integrate(BALL, begin, x), begin)  # noqa: E731
    np.testing.assert_allclose(jax.jacobian(there)(jnp.asarray(angle * AXIS)), np.eye(3), atol=2e-4)
