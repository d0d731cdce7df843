"""What the sealed cases of the benchmark and of the suite are drawn from."""

# In this order: effects take turns with the seeds, so that another list would hide other effects in cases of the same
# seeds, and figures of different releases would not be of the same cases. Later causes come with a suite of their own.
DRAWN = (
    "coulomb_friction", "stribeck_friction", "load_friction", "asymmetric_friction", "viscous_friction",
    "quadratic_drag", "armature", "joint_spring", "backlash", "joint_elasticity", "actuator_delay", "actuator_lag",
    "actuator_gain", "actuator_bias", "actuator_deadband", "actuator_saturation", "speed_torque_limit", "effort_loss",
    "cogging", "rate_limit", "payload", "gravity_tilt", "external_force", "base_flexibility", "contact_friction",
    "contact_compliance", "joint_offset", "sensor_delay", "sensor_filter", "sensor_gain",
)  # fmt: skip
