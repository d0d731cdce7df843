"""A robot of one's own, a balancer on two wheels, as a task; trained, and then adapted to a hidden reality.

    python examples/own_task.py [section.key=value ...]

Everything about the robot is here: its MJCF, what its policy sees, what is paid, and what about it is uncertain. Takes
two to three minutes on a laptop, most of them compilation.
"""

import argparse

import mujoco

from bayessim_mjx import loop
from bayessim_mjx.config import load
from bayessim_mjx.quantities import estimate
from bayessim_mjx.tasks.locomotion import Locomotion

ROBOT = """
<mujoco model="balancer">
  <option timestep="0.01" integrator="Euler" iterations="2" ls_iterations="6"> <flag eulerdamp="disable"/> </option>
  <default>
    <geom contype="0" conaffinity="0"/>
    <default class="wheel">
      <joint axis="0 1 0" damping="0.02" armature="0.005"/>
      <geom type="sphere" size="0.1" mass="0.4" contype="1" rgba="0.2 0.2 0.22 1"/>
    </default>
  </default>
  <worldbody>
    <light pos="0 -1 3"/>
    <geom name="floor" type="plane" size="0 0 1" conaffinity="1" rgba="0.8 0.82 0.85 1"/>
    <body name="trunk" pos="0 0 0.1">
      <freejoint/>
      <geom name="trunk" type="box" pos="0 0 0.2" size="0.04 0.09 0.15" mass="3" rgba="0.27 0.46 0.62 1"/>
      <body name="left_wheel" pos="0 0.15 0"> <joint name="left_wheel" class="wheel"/> <geom class="wheel"/> </body>
      <body name="right_wheel" pos="0 -0.15 0"> <joint name="right_wheel" class="wheel"/> <geom class="wheel"/> </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="left_wheel" joint="left_wheel" ctrlrange="-2 2"/>
    <motor name="right_wheel" joint="right_wheel" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""


class Balancer(Locomotion):
    """Stays upright and rolls and turns as it is told; actions: torques of the wheels / 2 N m."""

    control_dt = 0.02  # s
    default_episode_length = 200  # control steps
    commands = {"command_x": 0.5, "command_yaw": 1.0}  # largest, m/s and rad/s; drawn in each episode
    observations = {"velocity": 1.0, "turning": 0.25, "gravity": 1.0, "commands": 1.0, "joint_speeds": 0.05}
    rewards = {"alive": 0.2, "velocity": 1.0, "turning": 0.5, "actions": -0.02}
    speed_spread = 0.5  # rad/s of the wheels at the start
    reach = 2.0  # N m at the action 1
    least_upright = 0.7  # the cosine of the tilt at which an episode ends
    randomization = {  # factors of what is uncertain: masses of trunk and wheels, damping of the axles
        "randomization_params": {
            "actor_params": {
                "balancer": {
                    "rigid_body_properties": {"mass": {"range": [0.5, 2.0], "operation": "scaling"}},
                    "dof_properties": {"damping": {"range": [0.2, 5.0], "operation": "scaling"}},
                }
            }
        }
    }

    def spec(self):
        return mujoco.MjSpec.from_string(ROBOT)


REALITY = {"trunk_mass_mult": 1.6, "left_wheel_mass_mult": 1.0, "right_wheel_mass_mult": 1.0}  # what nobody knows
REALITY |= {"left_wheel_damping_mult": 3.0, "right_wheel_damping_mult": 0.5}
SMALL = [
    *("env.numEnvs=64", "ppo.num_steps=32", "ppo.max_iterations=30", "ppo.learning_rate=1e-3", "ppo.schedule=adaptive"),
    *("ppo.hidden_actor=[32,32]", "ppo.hidden_critic=[32,32]", "ppo.num_minibatches=4", "ppo.log_interval=15"),
    *("bayessim.trainTrajs=2000", "bayessim.trainTrajLen=20", "bayessim.summarizerFxn=summary_corrdiff"),
    *("bayessim.components=2", "bayessim.hiddenLayers=[64,64]", "bayessim.ensemble=1", "bayessim.checkTrajs=100"),
    *("bayessim.realIters=2", "bayessim.realEvals=16"),
]


class Progress:
    """Prints what the loop tells."""

    def training(self, round_, metrics, state):
        print(f"round {round_ + 1}: trained {int(state.train.iteration)}, return {metrics['Train/mean_reward']:.0f}")

    def round(self, info, policy):
        print(f"round {info.round + 1}: return on the real robot {info.returns.mean():.0f}")
        for warning in info.warnings:
            print(f"  note: {warning}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    overrides = parser.parse_known_args()[1]
    env = Balancer()
    print(f"observations: {', '.join(env.observation_names)}\nparameters: {', '.join(env.space.names)}")
    config = load("Balancer", overrides=[f"env.realParams={{means: [{REALITY}]}}", *SMALL, *overrides])
    parts = loop.make(config, env)
    state, _ = loop.run(parts, loop.init(parts), monitor=Progress())  # train on what is believed, look, infer; twice
    assert state.domain is not None
    for name, row in state.domain.describe().items():
        print(f"{name}: posterior {estimate(row['mean'], row['sd'])}, hidden truth {REALITY[name]}")


if __name__ == "__main__":
    main()
