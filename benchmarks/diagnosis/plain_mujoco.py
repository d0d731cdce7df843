"""Causes as people write them in plain MuJoCo, apart from the library's laws: what does `diagnose` name?

    python benchmarks/diagnosis/plain_mujoco.py --out DIR [--kinds soft_friction backlash ...] [--seed 0]

writes DIR/KIND/robot.xml, DIR/KIND/logs/ and DIR/KIND/truth.json, diagnoses them with all effects, and prints a table.

A torque-driven arm of two joints, 6 logs of 4 s at 50 Hz, encoders with 1 mrad of noise, velocities with 20 mrad/s. The
encoders sit on the motors. Friction is MuJoCo's frictionloss with its default softness, or a smooth tanh; play is a
joint of its own with MuJoCo's default limits; a spring is a joint of its own.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import bayessim_mjx as bm

PERIOD, STEP, ROWS, LOGS = 0.02, 0.0005, 200, 6  # s, s, control steps, recordings
NOISE = 1e-3, 2e-2  # rad, rad/s
JOINTS = ("shoulder", "elbow")
ELBOW = '<joint name="elbow" axis="0 1 0" damping=".08" armature=".01"/>'
ARM = f"""<mujoco><option timestep=".002" integrator="implicitfast"/>
<default><geom type="capsule" contype="0"/></default>
<worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping=".2"/>
  <geom fromto="0 0 0 0 0 -.3" size=".03" mass="1.2"/>
  <body name="fore" pos="0 0 -.3">{ELBOW}<geom fromto="0 0 0 0 0 -.25" size=".02" mass=".6"/></body>
</body></worldbody>
<actuator><motor name="m_shoulder" joint="shoulder"/><motor name="m_elbow" joint="elbow"/></actuator></mujoco>"""
MOTOR = ELBOW + '<inertial pos="0 0 0" mass=".001" diaginertia="1e-6 1e-6 1e-6"/>'
# force of friction at a joint by (speed, effort), N m
Law = Callable[[float, float], float]


@dataclass(frozen=True)
class Kind:
    """One cause.

    Attributes:
        effect, where: as the library calls it; "" for nothing.
        numbers: true ones.
        behind: attributes of a joint between the elbow's motor and its link; joint: more of the elbow's joint.
        friction: (joint, law) that acts besides; late: s, that commands arrive late.
    """

    effect: str
    where: str
    numbers: dict[str, float]
    behind: str = ""
    joint: str = ""
    friction: tuple[int, Law] | None = None
    late: float = 0.0


def smooth(level: Callable[[float, float], float]) -> Law:
    """Dry friction that grows with the speed up to some 20 mrad/s, as simulations regularise it."""
    return lambda speed, effort: -level(speed, effort) * np.tanh(speed / 0.02)


KINDS = {
    "nothing": Kind("", "", {}),
    "soft_friction": Kind("coulomb_friction", "elbow", {"level": 0.15}, joint='frictionloss=".15"'),
    "smooth_friction": Kind(
        "coulomb_friction", "elbow", {"level": 0.15}, friction=(1, smooth(lambda speed, effort: 0.15))
    ),
    "stribeck": Kind(
        "stribeck_friction",
        "elbow",
        {"level": 0.1},
        friction=(1, smooth(lambda speed, effort: 0.1 + 0.12 * np.exp(-((speed / 0.3) ** 2)))),
    ),
    "load": Kind(
        "load_friction", "shoulder", {"motor": 0.12}, friction=(0, smooth(lambda speed, effort: 0.12 * abs(effort)))
    ),
    "backlash": Kind("backlash", "elbow", {"encoder": 1.0}, behind='limited="true" range="-1.7 1.7" damping=".001"'),
    "spring": Kind(
        "joint_elasticity", "elbow", {"compliance": 1 / 12, "encoder": 1.0}, behind='stiffness="12" damping=".02"'
    ),
    "late": Kind("actuator_delay", "all", {"delay": PERIOD}, late=PERIOD),
}


def real(kind: Kind) -> mujoco.MjModel:
    """Return the model that stands for the real robot."""
    xml = ARM.replace('<joint name="elbow"', f'<joint {kind.joint} name="elbow"')
    if kind.behind:  # the elbow is the motor's, and the link hangs on it by a joint more
        motor = f'<body name="motor" pos="0 0 -.3">{MOTOR}<body name="fore"><joint axis="0 1 0" {kind.behind}/>'
        xml = ARM.replace(f'<body name="fore" pos="0 0 -.3">{ELBOW}', motor).replace("</body>", "</body></body>", 1)
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = STEP
    return model


def record(kind: Kind, rng: np.random.Generator) -> np.ndarray:
    """Return the rows of a log: time, positions, velocities, commands."""
    model = real(kind)
    data, dofs = mujoco.MjData(model), [model.joint(name).dofadr[0] for name in JOINTS]
    data.qpos[dofs] = rng.uniform(-0.8, 0.8, 2)
    mujoco.mj_forward(model, data)
    rate, phase = rng.uniform(0.3, 2.0, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))
    size = rng.uniform(0.2, 1.0, (2, 3)) * np.array([[2.5], [0.7]])
    time = PERIOD * np.arange(ROWS + 1)
    commands = (size * np.sin(2 * np.pi * rate * time[:, None, None] + phase)).sum(-1)
    out = []
    for t, command, arrived in zip(time, commands, np.maximum(time - kind.late, 0.0), strict=True):
        noise = rng.normal(size=(2, 2)) * np.array(NOISE)[:, None]
        out.append([t, *(data.qpos[dofs] + noise[0]), *(data.qvel[dofs] + noise[1]), *command])
        data.ctrl[:] = commands[round(arrived / PERIOD)]
        for _ in range(round(PERIOD / STEP)):
            if kind.friction is not None:
                joint, law = kind.friction
                dof = dofs[joint]
                data.qfrc_applied[dof] = law(float(data.qvel[dof]), float(data.qfrc_actuator[dof]))
            mujoco.mj_step(model, data)
    return np.array(out)


def write(kind: Kind, folder: Path, seed: int) -> None:
    """Write robot.xml, logs/ and truth.json."""
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(ARM)
    truth = {"effect": kind.effect, "where": kind.where, "numbers": kind.numbers}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    rng, names = np.random.default_rng(seed), [f"{what}:{j}" for what in ("qpos", "qvel") for j in JOINTS]
    header = ",".join(["time", *names, *(f"ctrl:m_{j}" for j in JOINTS)])
    for i in range(LOGS):
        np.savetxt(folder / f"logs/run{i}.csv", record(kind, rng), "%.7g", ",", header=header, comments="")


def named(kind: Kind, folder: Path) -> dict[str, Any]:
    """Diagnose a folder; return what was named beside the truth."""
    found = bm.diagnose(folder / "robot.xml", folder / "logs")
    effects = {f"{e.name}@{e.where}": e.parameters for e in found.effects}
    own = effects.get(f"{kind.effect}@{kind.where}", {})
    return {
        "verdict": found.verdict,
        "named": list(effects),
        "right": list(effects) == ([f"{kind.effect}@{kind.where}"] if kind.effect else []),
        "numbers": {n: [v, own[n].mean, own[n].sd] for n, v in kind.numbers.items() if n in own},
    }


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the cases")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--seed", type=int, default=0, help="of starts, commands and noise")
    parser.add_argument("--write_only", action="store_true", help="write the cases and diagnose nothing")
    args = parser.parse_args(argv)
    for name in args.kinds:
        write(KINDS[name], args.out / name, args.seed)
        if not args.write_only:
            row = named(KINDS[name], args.out / name)
            (args.out / name / "named.json").write_text(json.dumps(row, indent=1))
            print(
                f"{name:16} {row['verdict']:12} {'right' if row['right'] else 'WRONG'} {row['named']} {row['numbers']}"
            )


if __name__ == "__main__":
    main()
