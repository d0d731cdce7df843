"""Rotations against MuJoCo's, angles at the ends of their range."""

import mujoco
import numpy as np

from bayessim_mjx.frames import rotation, wrap, xyzw


def test_rotation_is_mujocos():
    quat, matrix = np.array([0.1, -0.5, 0.7, 0.2]), np.zeros(9)
    quat /= np.linalg.norm(quat)
    mujoco.mju_quat2Mat(matrix, quat)
    np.testing.assert_allclose(rotation(quat), matrix.reshape(3, 3), atol=1e-6)
    np.testing.assert_allclose(xyzw(quat), quat[[1, 2, 3, 0]], rtol=1e-6)


def test_angles_wrap_to_the_half_open_range():
    pi = np.float32(np.pi)
    angles = np.float32([0.5, pi + 0.5, -pi - 0.5, 6.5 * pi])
    np.testing.assert_allclose(wrap(angles), [0.5, 0.5 - pi, pi - 0.5, pi / 2], atol=1e-5)
    assert float(wrap(pi)) == pi
