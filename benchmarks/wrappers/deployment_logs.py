"""Logs of deployments, as programs on robots write them: see deployments.py for the robots and their code."""

import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from deployments import CODES, Code, Drone, Net, Robot, begin, cables


def record(
    folder: Path, task: str, model: mujoco.MjModel, net: Path, wrong: dict[str, Any], how: dict[str, Any], seed: int
) -> None:
    """Write logs of one deployment.

    Args:
        wrong: mistakes. how: of the recording: noise, episodes, seconds, rows (per step), own_noise (of the log's
            sensors), digits, drop (streams left out), jitter (share of late steps), period (share of the right one).
    """
    rng = np.random.default_rng(seed)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for episode in range(how.get("episodes", 6 if task == "Quadcopter" else 3)):
        robot = Robot(model, seed + 100 * episode, how.get("noise", 0.0), how.get("grain", 0.0))
        code = CODES[task](Net(net), wrong, rng)
        begin(robot, task, rng)
        rows = _written(_episode(robot, code, how, wrong, rng), how, rng)
        streams = [s for s in ("observation", "action", "ctrl", "qpos", "qvel", "task") if s not in how.get("drop", ())]
        if task != "Anymal":
            streams = [s for s in streams if s != "task"]
        names = columns(model, code.net.facts)
        header = ["time", *(f"{s}:{n}" for s in streams for n in names[s])]
        table = np.array([[row["time"], *np.concatenate([row[s] for s in streams])] for row in rows])
        form = f"%.{how.get('digits', 9)}g"
        np.savetxt(
            folder / f"run_{episode}.csv",
            table,
            ["%.9g"] + [form] * (len(header) - 1),
            ",",
            header=",".join(header),
            comments="",
        )


def _written(rows: list[dict], how: dict[str, Any], rng: np.random.Generator) -> list[dict]:
    """Rows as a program writes them: some lost, every n-th alone, state of a moment later, quaternions flipped."""
    if "state_rows_late" in how:  # the state of a row is that of a few rows later
        n = how["state_rows_late"]
        state = [{key: row[key] for key in ("qpos", "qvel")} for row in rows[n:]]
        rows = [row | later for row, later in zip(rows, state, strict=False)]
    if "lost" in how:
        rows = [row for row in rows if rng.random() > how["lost"]]
    if "every" in how:
        rows = rows[:: how["every"]]
    if "flips" in how:
        for row in rows:
            if rng.random() < 0.5:
                row["qpos"][3:7] *= -1
    if "gaps" in how:  # a sensor that is read less often
        for k, row in enumerate(rows):
            if k % how["gaps"]:
                row["qvel"] = np.full_like(row["qvel"], np.nan)
    return rows


def _episode(
    robot: Robot, code: Code, how: dict[str, Any], wrong: dict[str, Any], rng: np.random.Generator
) -> list[dict]:
    dt, rows, t = float(code.net.facts["control_dt"]) * wrong.get("period", 1.0), [], 0.0
    usual = 1.0 if isinstance(code, Drone) else 4.0  # an untrained policy flies no longer
    for k in range(round(how.get("seconds", usual) / dt)):
        if k % 40 == 0:
            code.target = rng.uniform((-2, -1, -1), (2, 1, 1))
        seen = robot.read()
        obs = code.observe(_biased(seen, how))
        action = code.act(obs)
        command = code.command(action)
        robot.data.ctrl[:] = cables(command, code)
        raw = action * 1.5 if "unclipped_in_the_log" in how else action
        action_ = np.where(np.abs(action) >= 1, raw, action)
        logged = {"observation": obs, "action": action_, "ctrl": command, "task": code.target}

        def write(later: float, seen: dict | None = None, t: float = t, logged: dict = logged) -> None:
            shown = seen or robot.read()
            own = how.get("own_noise", 0.0)
            qpos = shown["qpos"] + own * rng.normal(size=shown["qpos"].shape)
            rows.append(
                {
                    "time": t + later,
                    **logged,
                    "qpos": qpos,
                    "qvel": shown["qvel"] + 20 * own * rng.normal(size=shown["qvel"].shape),
                }
            )

        write(0.0, seen)
        late = rng.random() < max(how.get("jitter", 0.0), wrong.get("late_steps", 0.0))
        step = dt * (2.0 if late else 1.0)
        robot.wait(step, write if how.get("rows", 1) > 1 else None, how.get("rows", 1))
        t += step * (1 + how.get("clock", 0.0)) + 0.02 * dt * rng.normal() * (how.get("jitter", 0) > 0)
    return rows


def _biased(seen: dict[str, np.ndarray], how: dict[str, Any]) -> dict[str, np.ndarray]:
    """What the policy's own sensors see: a gyroscope and joints with small offsets that the log's have not."""
    if "bias" not in how:
        return seen
    first = len(seen["qpos"]) - len(seen["qvel"]) + 6
    qpos, qvel = seen["qpos"].copy(), seen["qvel"].copy()
    qpos[first:] += how["bias"]
    qvel[3:6] += how["bias"]
    return {"qpos": qpos, "qvel": qvel}


def columns(model: mujoco.MjModel, facts: dict[str, Any]) -> dict[str, list[str]]:
    """Names of the columns of each stream."""
    qpos, qvel = [], []
    for i in range(model.njnt):
        name, kind = model.joint(i).name, model.jnt_type[i]
        qpos += [f"{name}[{k}]" for k in range(7)] if kind == 0 else [name]
        qvel += [f"{name}[{k}]" for k in range(6)] if kind == 0 else [name]
    actions = facts["action_names"]
    return {
        "observation": facts["observation_names"], "action": actions, "ctrl": actions, "qpos": qpos, "qvel": qvel,
        "task": ["command_x", "command_y", "command_yaw"],
    }  # fmt: skip
