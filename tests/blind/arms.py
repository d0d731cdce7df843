"""An arm of one link, with a motor or a servo, and a sole above a step, with causes at their first place."""

import numpy as np

from bayessim_mjx.blind.reality.menu import CAUSES, places
from bayessim_mjx.blind.reality.plant import Plant, scales_of
from bayessim_mjx.blind.robot import Motion

MASS, LENGTH, GRAVITY = 0.6, 0.2, 9.81  # of the arm, to its centre of mass
ARM = f"""<mujoco><option timestep=".005" integrator="implicitfast"/><worldbody><body name="base">
<geom size=".05" mass="3" contype="0" conaffinity="0"/><body name="link">
<joint name="hinge" axis="0 1 0" damping=".02" armature=".006"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia=".008 .008 .001"/></body></body></worldbody>
<actuator>{{}}</actuator></mujoco>"""
MOTOR = '<motor name="drive" joint="hinge" ctrlrange="-4 4"/>'
SERVO = '<position name="drive" joint="hinge" kp="5" kv=".3"/>'
FALL = """<mujoco><option timestep=".002"/><worldbody><frame euler="0 90 0">
<geom name="step" type="box" size=".1 1 1" pos=".1 0 0"/></frame>
<body name="stand" pos="0 0 1"><geom name="shell" size=".05"/><body name="sole" pos="0 0 -.5">
<joint name="z" type="slide" axis="0 0 1"/><geom name="foot" size=".1" mass="1"/></body></body></worldbody>
<actuator><motor name="push" joint="z" ctrlrange="-2 2"/></actuator></mujoco>"""


def sole(centre: float = 0.0) -> Motion:
    return Motion("sole", FALL, 0.01, False, (30.0,), (3.0,), (centre,), (0.08,), 0.5, (4e-4,), only=2)


def arm(drive: str = MOTOR) -> Motion:
    servo = drive == SERVO
    return Motion("arm", ARM.format(drive), 0.02, servo, (3.0,), (0.3,), (0.6,), (1.0,), 0.5, (4e-4,), only=2)


def hidden(rig: Motion, name: str, size: float = 0.0, seed: int = 0, **own):
    plain = Plant(rig, {})
    scales = scales_of(plain, [rig.record(plain, i, 0, noise=False) for i in (0, 2)])
    cause = CAUSES[name](places(rig, name, scales)[0], scales, np.random.default_rng(seed), size)
    vars(cause).update(own)
    return cause
