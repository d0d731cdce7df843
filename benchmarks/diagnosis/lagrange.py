"""Logs of a two-link arm that no part of which is MuJoCo's: Lagrange's equations, Runge and Kutta's steps of .1 ms.

    python benchmarks/diagnosis/lagrange.py --out CASES --seeds 1:3
    python -m bayessim_mjx.diagnose --model CASES/delay_s1/model.xml --data CASES/delay_s1/logs --out CASES/delay_s1/out

The benchmark's other generator (`blind.py`) simulates with MuJoCo C, in finer steps but by the same equations and the
same MJCF. Here the robot is written down anew: a planar arm under gravity, PD control by a 14-bit encoder at 100 Hz,
torques held for a control step. Masses, damping and rotor inertias are within 8 % of the model's. One cause is hidden
in each case (two in the last); `truth.json` says which.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

MODEL = """<mujoco model="planar_arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02"/>
      <inertial pos="0 0 -.18" mass="1.6" diaginertia=".02 .02 .001"/>
      <body name="lower" pos="0 0 -.35"><joint name="elbow" axis="0 1 0" damping="0.05" armature="0.008"/>
        <inertial pos="0 0 -.14" mass=".8" diaginertia=".006 .006 .0004"/></body></body>
  </worldbody>
  <actuator><motor name="shoulder_motor" joint="shoulder" ctrlrange="-20 20"/>
    <motor name="elbow_motor" joint="elbow" ctrlrange="-8 8"/></actuator>
</mujoco>"""
LENGTH, TIP = 0.35, 0.28  # m, of the upper link; from the elbow to a load
PERIOD, STEP, SECONDS = 0.01, 1e-4, 4.0
ENCODER = 2 * np.pi / 2**14
STIFFNESS, WEAR = np.array([45.0, 16.0]), np.array([3.0, 1.0])  # of the controller, N m/rad and N m s/rad
LIMIT = np.array([20.0, 8.0])  # N m
MOTIONS = ("multisine", "multisine", "chirp", "chirp", "steps", "steps", "triangle", "triangle")
CAUSES = {
    "nothing": {},
    "inertial": {"centre": -0.008, "inertia": 1.25},  # m and a factor, of the lower link
    "payload": {"payload": 0.15},  # kg at the tip
    "lugre": {"lugre": 0.12},  # N m at the elbow, half as much again from rest
    "gain_lag": {"gain": 0.82, "lag": 0.02},  # of the shoulder's motor; s of both
    "backlash": {"backlash": 0.03},  # rad at the elbow, between the rotor and the link
    "fade": {"fade": 0.2},  # share of the shoulder's torque that is lost with 1.5 s
    "spring": {"spring": 1.2},  # N m/rad at the shoulder, at rest at .3 rad
    "delay": {"delay": 0.015},  # s, of both motors
    "coupling": {"coupling": 0.6},  # N m at the shoulder times sin(3 q_elbow): the library has no such law
    "payload_lugre": {"payload": 0.12, "lugre": 0.1},
}


@dataclass
class Arm:
    """The robot: its own numbers, and what is hidden."""

    hidden: dict
    masses: np.ndarray = field(default_factory=lambda: np.array([1.6, 0.8]))
    inertias: np.ndarray = field(default_factory=lambda: np.array([0.02, 0.006]))
    centres: np.ndarray = field(default_factory=lambda: np.array([0.18, 0.14]))
    damping: np.ndarray = field(default_factory=lambda: np.array([0.1, 0.05]))
    rotors: np.ndarray = field(default_factory=lambda: np.array([0.02, 0.008]))

    def __post_init__(self) -> None:
        self.centres = self.centres + [0.0, self.hidden.get("centre", 0.0)]
        self.inertias = self.inertias * [1.0, self.hidden.get("inertia", 1.0)]

    @classmethod
    def drawn(cls, hidden: dict, rng: np.random.Generator) -> Arm:
        """Within 8 % of the model; a heavier link has a larger inertia."""
        mass, wear, rotor = (1 + 0.08 * rng.uniform(-1, 1, 2) for _ in range(3))
        plain = cls({})
        return cls(
            hidden,
            plain.masses * mass,
            plain.inertias * mass,
            plain.centres,
            plain.damping * wear,
            plain.rotors * rotor,
        )

    def acceleration(self, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """[N, 2] rad/s^2 of joint torques that include friction."""
        load = self.hidden.get("payload", 0.0)
        (m1, m2), (c1, c2), (i1, i2) = self.masses, self.centres, self.inertias
        own = m2 * c2**2 + i2 + load * TIP**2
        lever = m2 * c2 + load * TIP
        cos, sin = np.cos(q[:, 1]), np.sin(q[:, 1])
        rotor = 0.0 if "backlash" in self.hidden else self.rotors[1]
        m11 = m1 * c1**2 + i1 + (m2 + load) * LENGTH**2 + own + 2 * lever * LENGTH * cos + self.rotors[0]
        m12, m22 = own + lever * LENGTH * cos, own + rotor
        below = 9.81 * lever * np.sin(q.sum(1))
        weight = 9.81 * (m1 * c1 + (m2 + load) * LENGTH) * np.sin(q[:, 0]) + below
        turn = lever * LENGTH * sin
        first = torque[:, 0] + turn * (2 * v[:, 0] * v[:, 1] + v[:, 1] ** 2) - weight
        second = torque[:, 1] - turn * v[:, 0] ** 2 - below
        det = m11 * m22 - m12**2
        return np.stack([m22 * first - m12 * second, m11 * second - m12 * first], 1) / det[:, None]

    def change(self, state: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Of [N, 7]: angles, speeds, the bristles' bend, the elbow rotor's angle and speed."""
        q, v, bend, rotor, turning = state[:, :2], state[:, 2:4], state[:, 4], state[:, 5], state[:, 6]
        out, total, hidden = np.zeros_like(state), torque - self.damping * v, self.hidden
        if "lugre" in hidden:  # Canudas de Wit et al., 1995
            level = hidden["lugre"]
            stiff = level / 2e-3
            steady = level * (1 + 0.5 * np.exp(-((v[:, 1] / 0.1) ** 2)))
            out[:, 4] = v[:, 1] - stiff * np.abs(v[:, 1]) / steady * bend
            total[:, 1] -= stiff * bend + 0.02 * np.sqrt(stiff) * out[:, 4]
        if "spring" in hidden:
            total[:, 0] -= hidden["spring"] * (q[:, 0] - 0.3)
        if "coupling" in hidden:
            total[:, 0] += hidden["coupling"] * np.sin(3 * q[:, 1])
        if "backlash" in hidden:
            gap = rotor - q[:, 1]
            pressed = gap - np.clip(gap, -hidden["backlash"] / 2, hidden["backlash"] / 2)
            passed = 800 * pressed + np.where(pressed != 0, 2.0 * (turning - v[:, 1]), 0.0)
            out[:, 6] = (torque[:, 1] - passed) / self.rotors[1]
            total[:, 1] += passed - torque[:, 1]
        out[:, :2], out[:, 2:4], out[:, 5] = v, self.acceleration(q, v, total), turning
        return out


def driven(arm: Arm, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encoders and commands [N, T, 2] under the controller that follows `wanted` [N, T, 2]."""
    count, hidden, substeps = len(wanted), arm.hidden, round(PERIOD / STEP)
    state = np.zeros((count, 7))
    state[:, :2], state[:, 5] = 0.9 * wanted[:, 0], 0.9 * wanted[:, 0, 1]
    waiting = [np.zeros((count, 2))] * round(hidden.get("delay", 0.0) / STEP)
    acting, speed, last = np.zeros((count, 2)), np.zeros((count, 2)), state[:, :2].copy()
    seen, commands = [], []
    for k in range(wanted.shape[1]):
        angle = np.round(state[:, :2] / ENCODER) * ENCODER
        speed, last = 0.6 * speed + 0.4 * (angle - last) / PERIOD, angle
        command = np.clip(STIFFNESS * (wanted[:, k] - angle) - WEAR * speed, -LIMIT, LIMIT)
        seen.append(angle)
        commands.append(command)
        for i in range(substeps):
            waiting.append(command)
            lost = hidden.get("fade", 0.0) * (1 - np.exp(-(k * PERIOD + i * STEP) / 1.5))
            target = waiting.pop(0) * np.array([hidden.get("gain", 1.0) - lost, 1.0])
            acting = acting + STEP * (target - acting) / hidden["lag"] if "lag" in hidden else target
            state = stepped(arm, state, acting)
    return np.stack(seen, 1), np.stack(commands, 1)


def stepped(arm: Arm, state: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """After a step of Runge and Kutta's fourth order."""
    a = arm.change(state, torque)
    b = arm.change(state + STEP / 2 * a, torque)
    c = arm.change(state + STEP / 2 * b, torque)
    d = arm.change(state + STEP * c, torque)
    return state + STEP / 6 * (a + 2 * b + 2 * c + d)


def motion(kind: str, rng: np.random.Generator) -> np.ndarray:
    """[T, 2] rad that the joints are to follow."""
    time = np.arange(round(SECONDS / PERIOD)) * PERIOD
    out = np.zeros((len(time), 2))
    for j, (middle, size) in enumerate(((0.5, 0.7), (0.6, 0.8))):
        if kind == "multisine":
            shape = sum(np.sin(2 * np.pi * f * time + rng.uniform(0, 2 * np.pi)) for f in (0.4, 0.9, 1.7)) / 2
        elif kind == "chirp":
            shape = 0.7 * np.sin(2 * np.pi * (0.3 * time + 0.9 * time**2 / SECONDS) + rng.uniform(0, 2 * np.pi))
        elif kind == "steps":
            shape = np.repeat(rng.uniform(-1, 1, 8), len(time) // 8)
        else:
            shape = 4 * np.abs((time * rng.uniform(0.3, 0.6) + rng.uniform()) % 1 - 0.5) - 1
        out[:, j] = middle + size * shape
    return out


def write(folder: Path, name: str, seed: int) -> None:
    """A case: model.xml, logs/, truth.json."""
    rng = np.random.default_rng((seed, list(CAUSES).index(name)))
    arm = Arm.drawn(CAUSES[name], rng)
    angles, commands = driven(arm, np.stack([motion(kind, rng) for kind in MOTIONS]))
    logs = folder / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(MODEL)
    for k, (kind, q, u) in enumerate(zip(MOTIONS, angles, commands, strict=True)):
        path = logs / f"{k:02d}_{kind}.csv"
        header = "time,ctrl:shoulder_motor,ctrl:elbow_motor,qpos:shoulder,qpos:elbow"
        table = np.column_stack([np.arange(len(q)) * PERIOD, u, q])
        np.savetxt(path, table, "%.9g", ",", header=header, comments="")
        path.with_suffix(".yaml").write_text(f"operating_condition: {kind}\ncontroller: {{law: torque}}\n")
    known = {n: getattr(arm, n).tolist() for n in ("masses", "inertias", "centres", "damping", "rotors")}
    (folder / "truth.json").write_text(json.dumps({"case": name, "hidden": arm.hidden, "robot": known}, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="0:1", help="first:last, the last is not included")
    parser.add_argument("--causes", default=",".join(CAUSES), help=f"of {', '.join(CAUSES)}")
    args = parser.parse_args()
    first, last = map(int, args.seeds.split(":"))
    for seed in range(first, last):
        for name in args.causes.split(","):
            write(args.out / f"{name}_s{seed}", name, seed)
            print(f"{name}_s{seed}", flush=True)


if __name__ == "__main__":
    main()
