"""All causes by name, and where each makes sense on a robot."""

from collections.abc import Sequence

import numpy as np

from bayessim_mjx.blind.reality import actuators, bodies, drives, joints, others, unknown
from bayessim_mjx.blind.reality.cause import Cause, Scales
from bayessim_mjx.blind.reality.plant import Rig

_ROTOR = ("backlash", "joint_elasticity")


def _causes(*rooms: object) -> dict[str, type[Cause]]:
    every = [c for room in rooms for c in vars(room).values() if isinstance(c, type) and issubclass(c, Cause)]
    return {c.name: c for c in every if "name" in vars(c)}


KNOWN = _causes(joints, actuators, others, drives, bodies)
UNKNOWN = _causes(unknown)  # no library has them
CAUSES = KNOWN | UNKNOWN


def places(system: Rig, effect: str, scales: Scales) -> list[str]:
    """Where the effect makes sense on this robot."""
    kind = CAUSES[effect].kind
    if kind == "actuator":
        alone = effect == "unknown_cross_spring" and len(scales.force) < 2
        linked = [a for a, joint in scales.drives.items() if any(scales.chain[joint])]
        some = dict.fromkeys(("servo_stiffness", "servo_damping"), scales.servo) | {
            "actuator_lag": scales.direct,
            "acceleration_limit": scales.led,
            "effort_coupling": linked,
        }
        able = some.get(effect, scales.drives)
        return [] if alone else [a for a in scales.drives if a in able]
    if effect == "ground_height":
        return ["world"] if system.touching and scales.ground else []
    if kind == "world":
        standing = effect != "base_flexibility" or scales.base
        return ["world"] if system.tilts and standing else []
    if kind == "geom":
        return list(system.touching)
    if effect in ("body_drag", "directional_drag", "wind"):
        return list(scales.floats)
    if kind == "body":  # what is carried is carried at the end
        return list(scales.length if effect == "inertial_parameters" else scales.ends)
    return list(scales.rotors) if effect in _ROTOR else list(scales.force)


def draw_cause(
    effect: str | tuple[str, str], robot: Rig, scales: Scales, taken: Sequence[Cause], rng: np.random.Generator
) -> Cause:
    """Draw a cause of size 0 at a place (given with the effect, or drawn) that no other one has taken.

    Raises:
        ValueError: the effect makes no sense on this robot.
    """
    name, where = (effect, None) if isinstance(effect, str) else effect
    allowed = places(robot, name, scales)
    if not allowed:
        raise ValueError(f"{name} makes no sense on {robot.name}")
    free = [p for p in allowed if p not in {c.where for c in taken}]
    drawn = str(rng.choice(free or allowed))
    return CAUSES[name](where or drawn, scales, rng)
