"""What people call the effects, for sentences and for the report."""

# effect: (what people call it, kind of place)
EFFECTS = {
    "actuator_delay": ("command delay", "actuator"),
    "actuator_lag": ("actuator lag", "actuator"),
    "actuator_gain": ("wrong actuator gain", "actuator"),
    "actuator_bias": ("effort bias", "actuator"),
    "actuator_deadband": ("command deadband", "actuator"),
    "actuator_saturation": ("effort saturation", "actuator"),
    "speed_torque_limit": ("speed-torque limit", "actuator"),
    "effort_loss": ("effort loss at high load", "actuator"),
    "cogging": ("cogging", "actuator"),
    "rate_limit": ("command rate limit", "actuator"),
    "coulomb_friction": ("Coulomb friction", "joint"),
    "stribeck_friction": ("Stribeck friction", "joint"),
    "viscous_friction": ("viscous friction", "joint"),
    "load_friction": ("load-dependent friction", "joint"),
    "asymmetric_friction": ("direction-dependent friction", "joint"),
    "quadratic_drag": ("quadratic drag", "joint"),
    "backlash": ("backlash", "joint"),
    "joint_elasticity": ("elastic transmission", "joint"),
    "joint_spring": ("spring", "joint"),
    "armature": ("added rotor inertia", "joint"),
    "joint_offset": ("angle offset", "joint"),
    "payload": ("extra payload", "body"),
    "gravity_tilt": ("tilted base", "world"),
    "external_force": ("external force", "body"),
    "base_flexibility": ("flexible mount", "world"),
    "contact_friction": ("changed contact friction", "geom"),
    "contact_compliance": ("contact compliance", "geom"),
    "sensor_delay": ("measurement delay", "joint"),
    "sensor_filter": ("measurement filter", "joint"),
    "sensor_gain": ("wrong sensor gain", "joint"),
}
# what a simulator lacks that lacks the effect, where that is not simply its name
LACKS = {
    "actuator_delay": "a command delay",
    "actuator_lag": "an actuator lag",
    "actuator_gain": "the true actuator gain",
    "actuator_bias": "an effort bias",
    "actuator_deadband": "a command deadband",
    "actuator_saturation": "an effort limit",
    "speed_torque_limit": "a speed-torque limit",
    "effort_loss": "an effort loss at high load",
    "rate_limit": "a command rate limit",
    "joint_elasticity": "an elastic transmission",
    "joint_spring": "a spring",
    "armature": "rotor inertia",
    "joint_offset": "an angle offset",
    "payload": "an extra payload",
    "gravity_tilt": "the tilt of the base",
    "external_force": "an external force",
    "base_flexibility": "a flexible mount",
    "contact_friction": "the true contact friction",
    "sensor_delay": "a measurement delay",
    "sensor_filter": "a measurement filter",
    "sensor_gain": "the true sensor gain",
}


def missing(name: str, where: str) -> str:
    """`a command delay at torque`, after "the simulator lacks"."""
    noun, kind = EFFECTS.get(name, (name.replace("_", " "), ""))
    what = LACKS.get(name, noun)
    if where in ("", "world") or (kind == "world" and where == "all"):
        return what
    return f"{what} at all {kind or 'place'}s" if where == "all" else f"{what} at {where}"


def listed(names: list[str], last: str = "and") -> str:
    """`a, b and c`."""
    return f" {last} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
