"""The robots of `free_bodies`, and how they are flown, dived and driven: feedback of the true state, in numpy."""

import mujoco
import numpy as np

DRONE = """<mujoco model="drone">
  <option timestep="0.005" integrator="Euler"/>
  <worldbody>
    <body name="drone" pos="0 0 1">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="0.8" diaginertia="5e-3 5.5e-3 9e-3"/>
      <geom name="frame" type="box" size=".12 .12 .03" contype="0" conaffinity="0"/>
      <site name="front_left" pos=".14 .14 0"/>
      <site name="front_right" pos=".14 -.14 0"/>
      <site name="back_left" pos="-.14 .14 0"/>
      <site name="back_right" pos="-.14 -.14 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="front_left" site="front_left" gear="0 0 1 0 0 -.02" ctrlrange="0 5"/>
    <motor name="front_right" site="front_right" gear="0 0 1 0 0 .02" ctrlrange="0 5"/>
    <motor name="back_left" site="back_left" gear="0 0 1 0 0 .02" ctrlrange="0 5"/>
    <motor name="back_right" site="back_right" gear="0 0 1 0 0 -.02" ctrlrange="0 5"/>
  </actuator>
</mujoco>
"""

# neutrally buoyant: weight and lift cancel, the centre of lift is above that of mass (a moment that MuJoCo's gravcomp
# cannot have is left out of both model and truth)
VEHICLE = """<mujoco model="vehicle">
  <option timestep="0.005" integrator="Euler" density="1000" viscosity="0.001"/>
  <worldbody>
    <body name="hull" pos="0 0 -2" gravcomp="1">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="11" diaginertia=".2 .28 .3"/>
      <geom name="hull" type="box" size=".22 .16 .12" contype="0" conaffinity="0"/>
      <site name="front_left" pos=".16 .11 0" euler="0 0 -45"/>
      <site name="front_right" pos=".16 -.11 0" euler="0 0 45"/>
      <site name="back_left" pos="-.16 .11 0" euler="0 0 -135"/>
      <site name="back_right" pos="-.16 -.11 0" euler="0 0 135"/>
      <site name="up_front_left" pos=".12 .2 0"/>
      <site name="up_front_right" pos=".12 -.2 0"/>
      <site name="up_back" pos="-.2 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="front_left" site="front_left" gear="1 0 0 0 0 0" ctrlrange="-40 40"/>
    <motor name="front_right" site="front_right" gear="1 0 0 0 0 0" ctrlrange="-40 40"/>
    <motor name="back_left" site="back_left" gear="1 0 0 0 0 0" ctrlrange="-40 40"/>
    <motor name="back_right" site="back_right" gear="1 0 0 0 0 0" ctrlrange="-40 40"/>
    <motor name="up_front_left" site="up_front_left" gear="0 0 1 0 0 0" ctrlrange="-40 40"/>
    <motor name="up_front_right" site="up_front_right" gear="0 0 1 0 0 0" ctrlrange="-40 40"/>
    <motor name="up_back" site="up_back" gear="0 0 1 0 0 0" ctrlrange="-40 40"/>
  </actuator>
</mujoco>
"""

_WHEEL = """
      <body name="{side}_wheel" pos="0 {y} .06">
        <joint name="{side}_wheel" axis="0 1 0" damping=".01" armature=".002"/>
        <geom name="{side}_tyre" type="ellipsoid" size=".06 .01 .06" mass=".3" friction="1.2 .005 .0001"/>
      </body>"""
WHEELED = f"""<mujoco model="wheeled">
  <option timestep="0.0025" integrator="implicitfast" iterations="6" ls_iterations="6"/>
  <default><geom condim="3" solref=".02 1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="10 10 .1" friction=".02 .005 .0001"/>
    <body name="chassis">
      <freejoint name="root"/>
      <inertial pos="-.03 0 .07" mass="5" diaginertia=".04 .06 .08"/>
      <geom name="box" type="box" size=".15 .1 .03" pos="-.03 0 .09" contype="0" conaffinity="0"/>
      <geom name="caster" type="sphere" size=".02" pos="-.15 0 .02" friction=".02 .005 .0001"/>\
{_WHEEL.format(side="left", y=".12")}{_WHEEL.format(side="right", y="-.12")}
    </body>
  </worldbody>
  <actuator>
    <motor name="left_motor" joint="left_wheel" ctrlrange="-3 3"/>
    <motor name="right_motor" joint="right_wheel" ctrlrange="-3 3"/>
  </actuator>
</mujoco>
"""

Array = np.ndarray


def _rotation(quat: Array) -> Array:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


def _way(t: float, run: int, far: float, rate: float) -> tuple[Array, Array]:
    """Return the reference's place and speed: circles, eights and lines, another in each run."""
    w = rate * (1 + 0.25 * run)
    along = [(1, 1, 0.3), (1, 0.2, 0.5), (0.3, 1, 0.6), (0.8, -0.8, 0.2), (0.5, 0.6, 0.8)][run % 5]
    a = far * np.array(along)
    place = a * np.array([1 - np.cos(w * t), np.sin(w * t) if run % 2 else np.sin(2 * w * t) / 2, np.sin(1.3 * w * t)])
    turn = w * np.array([np.sin(w * t), np.cos(w * t) if run % 2 else np.cos(2 * w * t), 1.3 * np.cos(1.3 * w * t)])
    return place, a * turn


_DRONE_MIX = np.linalg.inv(
    np.array([[1, 1, 1, 1], [0.14, -0.14, 0.14, -0.14], [-0.14, -0.14, 0.14, 0.14], [-0.02, 0.02, 0.02, -0.02]])
)


def fly(q: Array, v: Array, t: float, run: int) -> Array:
    """Fly the drone: position, then attitude, by proportional and derivative gains."""
    place, speed = _way(t, run, 0.6, 1.5)
    ask = 6.0 * (place + [0, 0, 1] - q[:3]) + 3.5 * (speed - v[:3]) + [0, 0, 9.81]
    own = _rotation(q[3:7])
    up = ask / np.linalg.norm(ask)
    yaw = 0.4 * np.sin(0.9 * t + run)
    side = np.cross(up, [np.cos(yaw), np.sin(yaw), 0])
    side /= np.linalg.norm(side)
    goal = np.stack([np.cross(side, up), side, up], 1)
    error = 0.5 * (goal.T @ own - own.T @ goal)
    moment = -np.array([0.9, 0.9, 0.15]) * [error[2, 1], error[0, 2], error[1, 0]] - [0.12, 0.12, 0.06] * v[3:6]
    total = 0.8 * float(ask @ own[:, 2])
    return np.clip(_DRONE_MIX @ np.array([total, *moment]), 0, 5)


def _thrusters(xml: str) -> Array:
    """`[6, nu]`, force and moment in the body's axes per unit of each command."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    out = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(out, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return out.T


def dive(q: Array, v: Array, t: float, run: int) -> Array:
    """Drive the underwater vehicle along its way, turning."""
    place, speed = _way(t, run, 0.35, 1.6)
    own = _rotation(q[3:7])
    force = own.T @ (60.0 * (place + [0, 0, -2] - q[:3]) + 30.0 * (speed - v[:3]))
    goal = 0.5 * np.array([np.sin(1.7 * t), np.sin(1.1 * t + run), np.sin(0.9 * t + 2 * run)])
    turned = np.zeros(3)
    mujoco.mju_quat2Vel(turned, q[3:7], 1.0)
    moment = 8.0 * (goal - turned) - 2.0 * v[3:6]
    return np.clip(np.linalg.pinv(_thrusters(VEHICLE)) @ np.concatenate([force, moment]), -40, 40)


def drive(q: Array, v: Array, t: float, run: int) -> Array:
    """Drive the wheels by torques after speeds that change in steps and waves."""
    w = 1.5 + 0.4 * run
    ahead = [4.0, 7.0, 5.0, 9.0, 6.0][run] * np.sin(w * t) + (4.0 if run % 2 else 2.0) * np.sign(np.sin(0.7 * w * t))
    turn = [2.0, 1.0, 3.0, 2.0, 4.0][run] * np.sin(0.6 * w * t + run)
    return np.clip(0.18 * (np.array([ahead - turn, ahead + turn]) - v[6:8]), -3, 3)
