"""Run an exported policy at its control rate on a stand-in for a robot, with safety stops, and write its logs.

bayessim-mjx play --task Pendulum --checkpoint best --export policy.onnx
python examples/deploy_loop.py --policy policy.onnx --seconds 20 --spread 3 --noise 0.001 --out logs/robot
bayessim-mjx diagnose --task Pendulum --data logs/robot

The policy needs numpy and onnxruntime alone. The stand-in is MuJoCo on the CPU: for your own robot replace `Robot`.
"""

import argparse
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

# goals that the policy is given; the log has them as task:<name>
GOALS: dict[str, float] = {}
# observations by their names in the policy file, from positions q and speeds w by joint
OBSERVED = {
    "cos_theta": lambda q, w: np.cos(q["hinge"]),
    "sin_theta": lambda q, w: np.sin(q["hinge"]),
    "theta_dot": lambda q, w: w["hinge"],
    "cart_position": lambda q, w: q["slider_to_cart"],
    "cart_velocity": lambda q, w: w["slider_to_cart"],
    "pole_angle": lambda q, w: q["cart_to_pole"],
    "pole_velocity": lambda q, w: w["cart_to_pole"],
}


class Policy:
    """An ONNX file of `play --export`: observation -> command, with its memory, at `dt` s."""

    def __init__(self, path: Path) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # threads that wait for each other are late now and then
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        texts = self.session.get_modelmeta().custom_metadata_map
        self.facts = {name: _value(text) for name, text in texts.items()}
        if "action_scale" not in self.facts:
            raise SystemExit(f"{path}: its actions are no commands by a scale; this loop cannot run it")
        self.dt, self.actuators = float(self.facts["control_dt"]), self.facts["action_names"]
        self.scale, self.offset = (np.array(self.facts[f"action_{name}"]) for name in ("scale", "offset"))
        self.memory = {i.name: np.zeros((1, i.shape[1]), np.float32) for i in self.session.get_inputs()[1:]}
        unknown = [name for name in self.facts["observation_names"] if name not in OBSERVED]
        if unknown:
            raise SystemExit(f"{path}: add to OBSERVED how to get {', '.join(unknown)} from joints")

    def check(self) -> float:
        """Return the largest difference to the actions that were stored with the policy."""
        golden = {name: self.facts.get(f"golden_{name}") for name in ("observation", "memory")}
        given = {name: np.array(x, np.float32) for name, x in golden.items() if x is not None}
        return float(np.abs(self.session.run(["action"], given)[0] - np.array(self.facts["golden_action"])).max())

    def __call__(self, q: dict[str, float], w: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(observation, action, command): the last two in the order of `actuators`."""
        seen = np.array([[OBSERVED[name](q, w) for name in self.facts["observation_names"]]], np.float32)
        action, *memory = self.session.run(
            ["action", *(f"{n}_next" for n in self.memory)], {"observation": seen, **self.memory}
        )
        self.memory = dict(zip(self.memory, memory, strict=True))
        return seen[0], action[0], self.offset + self.scale * action[0]


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


class Robot:
    """MuJoCo in the place of a robot: joints and actuators by name, in whatever order it has them."""

    def __init__(
        self, model: Any, joints: list[str], actuators: list[str], seed: int, spread: float = 0.1, noise: float = 0.0
    ) -> None:
        import mujoco

        self.random, self.noise = np.random.default_rng(seed), noise

        self.mujoco, self.model, self.data, self.joints = mujoco, model, mujoco.MjData(model), joints
        self.position = [int(model.joint(name).qposadr[0]) for name in joints]
        self.speed = [int(model.joint(name).dofadr[0]) for name in joints]
        self.drives = [model.actuator(name).id for name in actuators]
        self.data.qpos[self.position] += self.random.uniform(-spread, spread, len(joints))
        mujoco.mj_forward(model, self.data)

    def read(self) -> tuple[dict[str, float], dict[str, float]]:
        """Positions (rad, m), as the encoders have them, and speeds by joint."""
        q, w = self.data.qpos[self.position], self.data.qvel[self.speed]
        q = q + self.noise * self.random.normal(size=len(q))
        return dict(zip(self.joints, map(float, q), strict=True)), dict(zip(self.joints, map(float, w), strict=True))

    def write(self, command: np.ndarray) -> None:
        """Set the command that holds from now on."""
        self.data.ctrl[self.drives] = command

    def efforts(self) -> np.ndarray:
        """Return the forces of the actuators, N or N m."""
        return self.data.actuator_force[self.drives]

    def move(self, until: float) -> None:
        """Move on to `until` s after the start. (A robot does this by itself.)"""
        while self.data.time < until - 0.5 * self.model.opt.timestep:
            self.mujoco.mj_step(self.model, self.data)

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Return the allowed positions of the joints that have limits."""
        limited = [name for name in self.joints if self.model.joint(name).limited[0]]
        return {name: tuple(self.model.joint(name).range) for name in limited}

    def command_ranges(self) -> np.ndarray:
        """Return the allowed commands [2, A]."""
        limited = self.model.actuator_ctrllimited[self.drives].astype(bool)
        return np.where(limited, self.model.actuator_ctrlrange[self.drives].T, [[-np.inf], [np.inf]])


@dataclass
class Safety:
    """What stops the loop: each check gives a reason, or None."""

    ranges: dict[str, tuple[float, float]]
    max_speed: float
    max_effort: float
    watchdog: int  # late steps in a row
    late: int = field(default=0, init=False)

    def state(self, q: dict[str, float], w: dict[str, float], efforts: np.ndarray) -> str | None:
        for name, (low, high) in self.ranges.items():
            if not low <= q[name] <= high:
                return f"{name} is at {q[name]:.3g}, allowed is {low:.3g} to {high:.3g}"
        for name, speed in w.items():
            if not abs(speed) <= self.max_speed:
                return f"{name} moves at {speed:.3g}, allowed is {self.max_speed:.3g}"
        if not np.all(np.abs(efforts) <= self.max_effort):
            return f"an effort of {np.abs(efforts).max():.3g}, allowed is {self.max_effort:.3g}"
        return None

    def clock(self, late: float, dt: float) -> str | None:
        """`late`: s after the step's end was due."""
        self.late = self.late + 1 if late > 0 else 0
        return f"{self.late} steps in a row took longer than {1e3 * dt:.3g} ms" if self.late >= self.watchdog else None


def loop(policy: Any, robot: Robot, safety: Safety, seconds: float, fast: bool = False) -> tuple[list, np.ndarray, str]:
    """(rows of the log, seconds from reading to writing of each step, why it stopped or "").

    fast: without waiting for the clock.
    """
    rows, latency, reason = [], [], ""
    low, high = robot.command_ranges()
    begun = time.perf_counter()
    for k in range(round(seconds / policy.dt)):
        now = k * policy.dt if fast else time.perf_counter() - begun  # of the clock, so that the log shows late steps
        robot.move(now)
        read = time.perf_counter()
        q, w = robot.read()
        seen, action, command = policy(q, w)
        command = np.clip(command, low, high)
        stop = safety.state(q, w, robot.efforts())
        if stop is not None or not np.all(np.isfinite(command)):
            reason, command = stop or "the policy's command is not finite", np.zeros_like(command)
            seen, action = seen * np.nan, action * np.nan  # the command is not the policy's: nothing to compare
        robot.write(command)
        latency.append(time.perf_counter() - read)
        rows.append([now, *seen, *action, *command, *GOALS.values(), *q.values(), *w.values(), *robot.efforts()])
        due = read + policy.dt if fast else begun + (k + 1) * policy.dt
        late = time.perf_counter() - due
        reason = reason or safety.clock(late, policy.dt) or ""
        if reason:
            robot.write(np.zeros_like(command))
            break
        if not fast:
            time.sleep(max(0.0, -late))
    return rows, np.array(latency), reason


def write(folder: Path, rows: list, robot: Robot, policy: Policy, reason: str) -> Path:
    """One more log in the library's own format, and its metadata beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"run_{len(list(folder.glob('run_*.csv')))}.csv"
    columns = [f"observation:{name}" for name in policy.facts["observation_names"]]
    columns += [f"{c}:{a}" for c in ("action", "ctrl") for a in policy.actuators] + [f"task:{g}" for g in GOALS]
    columns += [f"{c}:{j}" for c in ("qpos", "qvel") for j in robot.joints]
    header = ",".join(["time", *columns, *(f"effort:{a}" for a in policy.actuators)])
    np.savetxt(path, np.array(rows), "%.9g", ",", header=header, comments="")
    note = {"checkpoint": policy.facts.get("checkpoint", ""), "note": reason or "ran to its end"}
    path.with_suffix(".yaml").write_text("".join(f"{key}: {json.dumps(value)}\n" for key, value in note.items()))
    return path


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, required=True, help="ONNX file of play --export")
    parser.add_argument("--model", help="MJCF file of the stand-in (default: that of the policy's task)")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--max_speed", type=float, default=30.0, help="rad/s or m/s of any joint")
    parser.add_argument("--max_effort", type=float, default=np.inf, help="N or N m of any actuator")
    parser.add_argument("--watchdog", type=int, default=3, help="late steps in a row that stop it")
    parser.add_argument("--fast", action="store_true", help="do not wait for the clock")
    parser.add_argument("--spread", type=float, default=0.1, help="how far from 0 it may begin, rad or m")
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation of its encoders, rad or m")
    parser.add_argument("--seed", type=int, default=0, help="of the first state and the noise")
    parser.add_argument("--out", type=Path, default=Path("logs/robot"))
    args = parser.parse_args()
    policy = Policy(args.policy)
    difference = policy.check()
    if difference > 1e-4:
        raise SystemExit(f"{args.policy}: this machine's actions differ by {difference:.2g} from the trainer's")
    model, joints = _model(args.model, policy), policy.facts["joint_names"]
    robot = Robot(model, joints, policy.actuators, args.seed, args.spread, args.noise)
    safety = Safety(robot.ranges(), args.max_speed, args.max_effort, args.watchdog)
    rows, latency, reason = loop(policy, robot, safety, args.seconds, args.fast)
    path = write(args.out, rows, robot, policy, reason)
    median, most = (1e3 * x for x in (np.median(latency), latency.max()))
    print(f"{len(rows)} steps of {1e3 * policy.dt:g} ms; latency {median:.2f} ms, at most {most:.2f} ms; log {path}")
    if reason:
        print(f"stopped: {reason}")
    return 1 if reason else 0


def _model(path: str | None, policy: Policy) -> Any:
    import mujoco

    if path is not None:
        return mujoco.MjModel.from_xml_path(path)
    from bayessim_mjx import registry
    from bayessim_mjx.errors import UserError

    try:
        return registry.make(policy.facts["task"]).mj_model
    except UserError as error:  # a task of your own
        raise SystemExit(f"{error}; or give --model FILE, the MJCF file of the stand-in") from None


if __name__ == "__main__":
    raise SystemExit(main())
