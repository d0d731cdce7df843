"""Small models that between them have every attribute, and their sections in BayesSimIG's format."""


def scaling(low, high, **more):
    return {"range": [low, high], "operation": "scaling", **more}


def additive(low, high, **more):
    return {"range": [low, high], "operation": "additive", **more}


PENDULUM_SECTION = {
    "actor_params": {
        "pendulum": {
            "rigid_body_properties": {"mass": scaling(0.01, 2)},
            "rigid_shape_properties": {"length": scaling(0.01, 2)},
        }
    }
}
CARTPOLE_SECTION = {
    "actor_params": {
        "cartpole": {
            "rigid_body_properties": {"mass": scaling(0.01, 20)},
            "rigid_shape_properties": {"friction": scaling(0.01, 10), "restitution": additive(0.01, 1)},
            "dof_properties": {"stiffness": additive(0.01, 2), "damping": additive(0.01, 100)},
        }
    }
}

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.01" gravity="0 0 -10"/>
  <statistic extent="3"/>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="side" pos="0 -3 1"/>
    <body name="pendulum" pos="0 0 1.5">
      <inertial mass="1" pos="0 0 0.5" diaginertia="0.0833333333333 0.0833333333333 1e-5"/>
      <joint name="hinge" axis="0 1 0"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="hinge" gear="2"/></actuator>
</mujoco>
"""

CARTPOLE = """
<mujoco model="cartpole">
  <option timestep="0.008" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <default><geom type="box" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="slider" pos="0 0 2">
      <geom size=".015 4 .015" mass="1"/>
      <body name="cart">
        <inertial mass="1" pos="0 0 0" diaginertia=".00854 .00667 .00854"/>
        <joint name="slider_to_cart" type="slide" axis="0 1 0"/>
        <geom size=".1 .125 .1"/>
        <body name="pole" pos=".12 0 0">
          <joint name="cart_to_pole" axis="1 0 0"/>
          <geom size=".02 .03 .5" pos="0 0 .47" mass="1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider_to_cart"/></actuator>
</mujoco>
"""

# a slanted leg, a leg with an explicit inertial, a knee with frictionloss, servos of every kind, tendons of both kinds,
# a contact pair that follows its geoms and one that does not, a loop closed by a connect constraint, a sliding block
WALKER = """
<mujoco model="walker">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" cone="pyramidal"/>
  <default>
    <geom density="400" friction="0.8 0.02 0.01" contype="0" conaffinity="1"/>
    <joint armature="0.01" damping="0.3"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction="1" contype="1" conaffinity="0"/>
    <body name="torso" pos="0 0 .6">
      <freejoint name="root"/>
      <camera name="track" mode="trackcom" pos="0 -2 1"/>
      <geom name="torso" type="ellipsoid" conaffinity="0" size=".2 .12 .08"/>
      <geom type="sphere" size=".06" pos=".2 0 .05" mass=".4"/>
      <site name="hook" pos="0 .05 .1"/>
      <body name="left_thigh" pos="0 .12 0">
        <joint name="left_hip" axis="0 1 0" range="-1 1" stiffness="2" springref=".1"/>
        <geom name="left_thigh" type="capsule" fromto="0 0 0 .1 .1 -.2" size=".04"/>
        <body name="left_shin" pos=".1 .1 -.2">
          <joint name="left_knee" axis="0 1 0" range="-1.5 0" frictionloss=".05" pos="0 0 .01"/>
          <geom name="left_shin" type="capsule" fromto="0 0 0 0 0 -.25" size=".03"/>
          <geom name="left_foot" type="sphere" pos="0 0 -.25" size=".04" mass=".1" solref=".03 .9"/>
          <site name="left_tip" pos="0 0 -.2"/>
        </body>
      </body>
      <body name="right_thigh" pos="0 -.12 0" euler=".2 0 0">
        <inertial mass="1.1" pos="0 0 -.1" diaginertia=".006 .005 .002"/>
        <joint name="right_hip" axis="0 1 0" range="-1 1"/>
        <geom name="right_thigh" type="cylinder" pos="0 0 -.1" size=".04 .1"/>
        <body name="right_shin" pos="0 0 -.2">
          <inertial mass=".7" pos="0 0 -.12" fullinertia=".006 .005 .002 .0001 .0002 -.0001"/>
          <joint name="right_knee" axis="0 1 0" range="-1.5 0"/>
          <geom name="right_shin" type="box" pos="0 0 -.12" size=".03 .03 .12"/>
        </body>
      </body>
    </body>
    <body name="block" pos="1 0 .1">
      <joint name="block_x" type="slide" axis="1 0 0" armature="0" damping="0"/>
      <geom name="block" type="box" size=".1 .1 .1"/>
    </body>
    <body name="swing" pos="-1 0 1">
      <joint name="swing_ball" type="ball"/>
      <geom name="swing" type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/>
      <body name="lever" pos="0 0 -.4">
        <joint name="lever_y" axis="0 1 0"/>
        <geom name="lever" type="box" pos=".1 0 0" size=".1 .02 .02"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="couple" stiffness="3" damping=".2" springlength=".1">
      <joint joint="left_knee" coef="1"/><joint joint="right_knee" coef="-1"/>
    </fixed>
    <spatial name="string" stiffness="1" damping=".1" frictionloss=".02" armature=".02">
      <site site="hook"/><site site="left_tip"/>
    </spatial>
  </tendon>
  <actuator>
    <position name="left_hip" joint="left_hip" kp="40" kv="2"/>
    <position name="right_hip" joint="right_hip" kp="40" dampratio="1"/>
    <velocity name="left_knee" joint="left_knee" kv="3"/>
    <motor name="right_knee" joint="right_knee" gear="5"/>
    <general name="pull" tendon="string" gainprm="7" biasprm="1 0 0" biastype="affine"/>
  </actuator>
  <equality>
    <connect body1="lever" body2="swing" anchor=".05 0 0"/>
  </equality>
  <contact>
    <pair geom1="floor" geom2="right_shin" friction="1 1 .005 .0001 .0001"/>
    <pair geom1="floor" geom2="right_thigh" friction=".33 .33 .005 .0001 .0001" solref=".05 1"/>
    <exclude body1="torso" body2="left_shin"/>
  </contact>
</mujoco>
"""
