"""Deployed policies with planted mistakes: robots in MuJoCo C, and control code as a programmer writes it for them.

Every mistake is a line of control code that is otherwise, switched by its name. Nothing here is shared with the check
of the contract: observations are written by hand for each robot, from the sensors' numbers.
"""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import onnxruntime

LEGS = ("LF", "LH", "RF", "RH")


def turn(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix, body to world, by MuJoCo."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat / np.linalg.norm(quat))
    return out.reshape(3, 3)


class Robot:
    """A robot and its sensors."""

    def __init__(self, model: mujoco.MjModel, seed: int, noise: float, grain: float = 0.0) -> None:
        self.model, self.data, self.rng, self.noise = model, mujoco.MjData(model), np.random.default_rng(seed), noise
        self.grain = grain  # resolution of the encoders

    def read(self) -> dict[str, np.ndarray]:
        """Positions and velocities with noise; quaternions have norm 1."""
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        qpos += self.noise * self.rng.normal(size=qpos.shape)
        qvel += 20 * self.noise * self.rng.normal(size=qvel.shape)
        first = 7 if self.model.jnt_type[0] == 0 else 0
        if self.grain:
            qpos[first:] = self.grain * np.round(qpos[first:] / self.grain)
        if first:
            qpos[3:7] /= np.linalg.norm(qpos[3:7])
        return {"qpos": qpos, "qvel": qvel}

    def wait(self, seconds: float, each: Any = None, rows: int = 1) -> None:
        steps = max(1, round(seconds / self.model.opt.timestep))
        for k in range(steps):
            mujoco.mj_step(self.model, self.data)
            if each is not None and (k + 1) % max(1, steps // rows) == 0 and k + 1 < steps:
                each((k + 1) * self.model.opt.timestep)


class Net:
    """The exported file on the robot's computer."""

    def __init__(self, path: Path) -> None:
        self.session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        facts = self.session.get_modelmeta().custom_metadata_map
        self.facts = {k: json.loads(v) for k, v in facts.items() if v[:1] in "[{0123456789-"}
        self.memory = {i.name: np.zeros((1, i.shape[1]), np.float32) for i in self.session.get_inputs()[1:]}
        self.mean, self.std = (np.array(self.facts.get(f"normaliser_{k}", d)) for k, d in (("mean", 0.0), ("std", 1.0)))

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        given = {"observation": np.asarray(obs, np.float32)[None], **self.memory}
        action, *memory = self.session.run(["action", *(f"{n}_next" for n in self.memory)], given)
        self.memory = dict(zip(self.memory, memory, strict=True))
        return action[0].astype(float)


class Code:
    """Control code of one robot: `observe` and `command`; `wrong` has the mistakes by name, with their amounts."""

    offset: Any = 0.0

    def __init__(self, net: Net, wrong: dict[str, Any], rng: np.random.Generator) -> None:
        self.net, self.wrong, self.rng = net, wrong, rng
        self.last = np.zeros(len(net.facts["action_names"]))
        self.before, self.old, self.filtered, self.target = self.last, [], self.last, np.zeros(3)
        self.count, self.kept, self.late = 0, None, []

    def pieces(self, seen: dict[str, np.ndarray]) -> list[np.ndarray]:
        raise NotImplementedError

    def observe(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        obs = np.concatenate(self.pieces(seen))
        self.old.append(obs)
        if "observation_late" in self.wrong:
            obs = self.old[max(0, len(self.old) - 1 - self.wrong["observation_late"])]
        if "observation_every" in self.wrong:
            obs = self.old[self.count - self.count % self.wrong["observation_every"]]
        if "packets_lost" in self.wrong and self.kept is not None and self.rng.random() < self.wrong["packets_lost"]:
            obs = self.kept
        if "normalised_twice" in self.wrong:
            obs = (obs - self.net.mean) / self.net.std
        self.kept = obs
        self.count += 1
        return obs

    def act(self, obs: np.ndarray) -> np.ndarray:
        if "memory_reset" in self.wrong:
            self.net.memory = {k: 0 * v for k, v in self.net.memory.items()}
        given = obs * self.net.std + self.net.mean if "normaliser_left_out" in self.wrong else obs
        action = self.net(given)
        if "sampled" in self.wrong:
            action = np.clip(action + self.wrong["sampled"] * self.rng.normal(size=action.shape), -1, 1)
        if "limited" in self.wrong:
            action = np.clip(action, -self.wrong["limited"], self.wrong["limited"])
        if "unlimited" in self.wrong:  # the last layer without its clip
            action = np.where(
                np.abs(action) >= 1, action * (1 + self.wrong["unlimited"] * self.rng.random(action.shape)), action
            )
        self.before, self.last = self.last, action
        return action

    def command(self, action: np.ndarray) -> np.ndarray:
        scale = np.array(self.net.facts["action_scale"])
        offset = np.array(self.net.facts["action_offset"])
        if "smoothed" in self.wrong:
            self.filtered = self.filtered + self.wrong["smoothed"] * (action - self.filtered)
            action = self.filtered
        if "actuators_swapped" in self.wrong:
            i, j = self.wrong["actuators_swapped"]
            action, offset = action.copy(), offset.copy()
            action[[i, j]], offset[[i, j]] = action[[j, i]], offset[[j, i]]
        if "actuator_sign" in self.wrong:
            action = action.copy()
            action[self.wrong["actuator_sign"]] *= -1
        if "action_scale" in self.wrong:
            scale = scale * self.wrong["action_scale"]
        if "pose_not_added" in self.wrong:
            offset = 0 * offset
        out = offset + scale * action
        self.late.append(out)
        return self.late[max(0, len(self.late) - 1 - self.wrong.get("command_late", 0))]


class Quadruped(Code):
    """IsaacGymEnvs' Anymal."""

    home = np.array([[0.03, 0.4, -0.8], [0.03, -0.4, 0.8], [-0.03, 0.4, -0.8], [-0.03, -0.4, 0.8]]).ravel()

    def pieces(self, seen: dict[str, np.ndarray]) -> list[np.ndarray]:
        quat, q, v = seen["qpos"][3:7], seen["qpos"][7:].copy(), seen["qvel"][6:].copy()
        rot, speed, gyro = turn(quat), seen["qvel"][:3], seen["qvel"][3:6]
        wrong = self.wrong
        if "joints_swapped" in wrong:
            i, j = wrong["joints_swapped"]
            q[[i, j]], v[[i, j]] = q[[j, i]], v[[j, i]]
            home = self.home.copy()
            home[[i, j]] = home[[j, i]]
        else:
            home = self.home
        if "legs_in_robot_order" in wrong:  # left and right in turn
            legs = [0, 2, 1, 3]
            q, v, home = (x.reshape(4, 3)[legs].ravel() for x in (q, v, home))
        if "joint_sign" in wrong:
            q[wrong["joint_sign"]] *= -1
            v[wrong["joint_sign"]] *= -1
        if "encoder_zero" in wrong:
            q[wrong["encoder_zero"][0]] += wrong["encoder_zero"][1]
        if "encoder_dead" in wrong:
            q[wrong["encoder_dead"]] = home[wrong["encoder_dead"]] + 0.11
        down = -rot[2]
        if "gravity_of_world" in wrong:
            down = np.array([0.0, 0.0, -1.0])
        if "gravity_by_inverse" in wrong:
            down = -rot[:, 2]
        if "gravity_up" in wrong:
            down = -down
        if "gravity_in_si" in wrong:
            down = 9.81 * down
        body = speed if "speed_of_world" in wrong else rot.T @ speed
        gyro = rot @ gyro if "gyro_of_world" in wrong else gyro
        gyro = np.degrees(gyro) if "gyro_in_degrees" in wrong else gyro
        if "imu_mounted" in wrong:  # turned about its z axis, or upside down
            mount = np.array(wrong["imu_mounted"], float).reshape(3, 3)
            gyro, down = mount @ gyro, mount @ down
        place = q if "pose_not_subtracted" in wrong else q - home
        place = np.degrees(place) if "joints_in_degrees" in wrong else place
        if "velocities_late" in wrong or "velocities_smoothed" in wrong:
            v = self._slow(v)
        factor = wrong.get("velocity_factor", 0.05)
        last = self.before if "action_of_two_steps" in wrong else self.last
        last = 0 * last if "no_action_fed_back" in wrong else last
        if "command_fed_back" in wrong and self.late:
            last = self.late[-1]
        asked = self.target * np.array(wrong.get("target_factors", (2.0, 2.0, 0.25)))
        return [2.0 * body, 0.25 * gyro, down, asked, place, factor * v, last]

    def _slow(self, v: np.ndarray) -> np.ndarray:
        self.speeds = [*getattr(self, "speeds", []), v]
        if "velocities_late" in self.wrong:
            return self.speeds[max(0, len(self.speeds) - 1 - self.wrong["velocities_late"])]
        share = self.wrong["velocities_smoothed"]
        self.smooth = v if len(self.speeds) == 1 else self.smooth + share * (v - self.smooth)
        return self.smooth


class Drone(Code):
    """IsaacGymEnvs' Quadcopter: quaternion x y z w, velocities in the world's axes, targets that move at a rate."""

    def pieces(self, seen: dict[str, np.ndarray]) -> list[np.ndarray]:
        place, quat, wrong = seen["qpos"][:3], seen["qpos"][3:7], self.wrong
        rot, speed, gyro = turn(quat), seen["qvel"][:3], seen["qvel"][3:6]
        way = (place - np.array([0, 0, 1.0])) if "way_reversed" in wrong else np.array([0, 0, 1.0]) - place
        attitude = np.array([*quat[1:], quat[0]])
        if "quaternion_wxyz" in wrong:
            attitude = quat
        if "quaternion_inverse" in wrong:
            attitude = np.array([*-quat[1:], quat[0]])
        spin = gyro if "gyro_of_body" in wrong else rot @ gyro
        speed = rot.T @ speed if "speed_of_body" in wrong else speed
        share = 1.0 if "spin_not_scaled" in wrong else 1 / np.pi
        joints = seen["qpos"][7:].copy()
        if "joints_swapped" in wrong:
            i, j = wrong["joints_swapped"]
            joints[[i, j]] = joints[[j, i]]
        return [way / 3.0, attitude, speed / 2, share * spin, joints]

    def command(self, action: np.ndarray) -> np.ndarray:
        rates = np.array([8 * np.pi] * 8 + [200.0] * 4)
        low, high = np.array([-np.pi / 6] * 8 + [0.0] * 4), np.array([np.pi / 6] * 8 + [2.0] * 4)
        self.late.append(np.clip((self.late[-1] if self.late else 0 * rates) + 0.01 * rates * action, low, high))
        return self.late[-1]


class Cart(Code):
    """IsaacGymEnvs' Cartpole."""

    def pieces(self, seen: dict[str, np.ndarray]) -> list[np.ndarray]:
        (x, angle), (speed, spin), wrong = seen["qpos"], seen["qvel"], self.wrong
        x = 1000 * x if "cart_in_mm" in wrong else x
        spin = np.degrees(spin) if "pole_in_degrees" in wrong else spin
        speed = -speed if "cart_speed_reversed" in wrong else speed
        angle, spin = (spin, angle) if "angle_and_spin_swapped" in wrong else (angle, spin)
        return [np.array([x, speed, angle, spin])]


class Swing(Code):
    """The pendulum: cosine, sine and speed."""

    def pieces(self, seen: dict[str, np.ndarray]) -> list[np.ndarray]:
        angle, speed, wrong = seen["qpos"][0], seen["qvel"][0], self.wrong
        cos, sin = np.cos(angle), np.sin(angle)
        cos, sin = (sin, cos) if "sine_and_cosine_swapped" in wrong else (cos, sin)
        speed = speed * 60 / (2 * np.pi) if "speed_in_rpm" in wrong else speed
        return [np.array([cos, sin, speed])]


CODES = {"Anymal": Quadruped, "Quadcopter": Drone, "Cartpole": Cart, "Pendulum": Swing}


def begin(robot: Robot, task: str, rng: np.random.Generator) -> None:
    """A start of an episode, drawn."""
    model, data = robot.model, robot.data
    mujoco.mj_resetData(model, data)
    if task == "Anymal":
        data.qpos[7:] = Quadruped.home + rng.uniform(-0.3, 0.3, 12)
        data.qpos[3:7] = np.array([1, *rng.uniform(-0.25, 0.25, 2), rng.uniform(-0.9, 0.9)])
        data.qvel[:6] = rng.uniform(-1, 1, 6)
    elif task == "Quadcopter":
        data.qpos[:3] += rng.uniform(-1, 1, 3)
        data.qpos[3:7] = np.array([1, *rng.uniform(-0.5, 0.5, 3)])
        data.qvel[:6] = rng.uniform(-1, 1, 6)
    else:
        data.qpos[:] = rng.uniform(-0.5, 0.5, model.nq) * (3.0 if task == "Pendulum" else 1.0)
        data.qvel[:] = rng.uniform(-1, 1, model.nv)
    if model.jnt_type[0] == 0:
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    mujoco.mj_forward(model, data)


def cables(command: np.ndarray, code: Code) -> np.ndarray:
    """What the drives get: cables may be in each other's place, a motor may be mounted the other way round."""
    out, rest = command.copy(), np.array(code.net.facts.get("action_offset", 0.0))
    if "cables_swapped" in code.wrong:
        i, j = code.wrong["cables_swapped"]
        out[[i, j]] = out[[j, i]]
    if "motor_reversed" in code.wrong:
        i = code.wrong["motor_reversed"]
        out[i] = 2 * rest[i] - out[i]
    return out
