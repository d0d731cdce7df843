"""The one control step, its controllers and integrators, and what episodes draw at random beside their parameters."""

from bayessim_mjx.physics.step import Physics, World, begin, control_step
from bayessim_mjx.physics.timestep import Drive, mjx, staggered, substep

__all__ = ["Drive", "Physics", "World", "begin", "control_step", "mjx", "staggered", "substep"]
