"""Look-alikes among the effects, and the library less the families of some effects."""

from collections.abc import Iterable

FAMILIES = (
    ("coulomb_friction", "stribeck_friction", "load_friction", "asymmetric_friction", "actuator_deadband",
     "lugre_friction"),
    ("viscous_friction", "quadratic_drag", "asymmetric_friction"),
    ("actuator_delay", "actuator_lag", "rate_limit", "acceleration_limit", "sensor_delay", "sensor_filter"),
    ("backlash", "joint_elasticity", "base_flexibility", "actuator_deadband", "sensor_delay", "actuator_delay",
     "actuator_lag", "lugre_friction"),
    # a sine of the angle at order 1 is what gravity does to one joint
    ("payload", "gravity_tilt", "external_force", "joint_spring", "joint_offset", "actuator_bias", "cogging",
     "gravity_compensation", "cable_tension", "inertial_parameters"),
    ("servo_stiffness", "servo_damping", "actuator_gain", "viscous_friction", "joint_spring"),
    ("actuator_gain", "sensor_gain", "armature", "payload", "actuator_saturation", "effort_loss", "speed_torque_limit",
     "gain_drift", "inertial_parameters", "effort_coupling"),
    ("contact_friction", "contact_compliance", "ground_height"),
    ("controller_stiffness", "controller_damping", "actuator_gain", "viscous_friction", "joint_spring"),
    ("body_drag", "directional_drag", "wind"),
    ("command_packets", "sensor_packets"),
)  # fmt: skip


def relatives(effects: Iterable[str]) -> set[str]:
    """The effects and everything that shares a family with one of them."""
    given = set(effects)
    return given.union(*(family for family in FAMILIES if given & set(family)))


def without(effects: Iterable[str], library: Iterable[str]) -> str:
    """The library less the families of these effects, for --effects."""
    left_out = relatives(effects)
    return ",".join(e for e in library if e not in left_out)
