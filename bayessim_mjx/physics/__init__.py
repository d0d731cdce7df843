"""The one control step, its controllers and integrators, and what episodes draw at random beside their parameters."""

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.site import early, staggered
from bayessim_mjx.physics.controllers import Drive
from bayessim_mjx.physics.model import Physics, World
from bayessim_mjx.physics.step import Past, begin, control_step, past_of, retraced
from bayessim_mjx.physics.timestep import substep

__all__ = [
    "Drive",
    "Past",
    "Physics",
    "World",
    "begin",
    "control_step",
    "early",
    "mjx",
    "past_of",
    "retraced",
    "staggered",
    "substep",
]
