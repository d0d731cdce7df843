"""Experiments as files that can be played: a CSV of commands and expected motion, and a YAML that says how."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.experiment.propose import Experiment

Array = NDArray[np.float64]


def write_command(path: str | Path, experiment: Experiment, source: str = "") -> Path:
    """Write `time, ctrl:<actuator>..., ref:<joint>...` (and `enabled:<actuator>`) and `<stem>.yaml` beside it.

    Args:
        source: the file or folder that the proposal came from.

    Raises:
        UserError: the proposal has nothing to play, or the file's ending is not .csv.
    """
    path = Path(path)
    if experiment.chosen is None:
        raise UserError(f"{path}: there is nothing to play: {experiment.why}")
    if path.suffix != ".csv":
        raise UserError(f"{path}: a command file ends in .csv")
    log = experiment.chosen.played.log
    table = {"time": log.time} | {f"ctrl:{n}": c for n, c in zip(log.actuators, log.ctrl.T, strict=True)}
    table |= {f"ref:{n}": c for n, c in zip(log.channels.qpos, log.qpos.T, strict=True)}
    table |= {k: s for k, s in log.streams.items() if k.startswith("enabled:")}
    path.parent.mkdir(parents=True, exist_ok=True)
    formats = ["%.12g"] + ["%.9g"] * (len(table) - 1)
    np.savetxt(path, np.stack(list(table.values()), 1), formats, ",", header=",".join(table), comments="")
    notes = yaml.safe_dump(_notes(path, experiment, source), sort_keys=False, width=110, allow_unicode=True)
    path.with_suffix(".yaml").write_text(notes)
    return path


def _notes(path: Path, e: Experiment, source: str) -> dict[str, Any]:
    assert e.chosen is not None
    log, d = e.chosen.played.log, e.drives
    torque = [i for i, kind in enumerate(d.kind) if kind == "torque"]
    notes: dict[str, Any] = {
        "experiment": e.name,
        "why": e.why,
        "expected_evidence_nats": round(e.evidence, 2),
        "needs": e.needs or "nobody: it runs by itself from the start position",
        "file": path.name,
        "source": source,
        "control_period": round(log.period, 9),
        "start": {n: round(float(x), 6) for n, x in zip(log.channels.qpos, log.qpos[0], strict=True)},
        "kind": dict(zip(log.actuators, d.kind, strict=True)),
        "how_to_play": "Bring the robot to rest at `start`. Send row k of ctrl at time[k] and hold it until time[k+1].",
        "limits": _limits(e),
        "how_to_log": {
            "columns": ["time", *(f"ctrl:{n}" for n in log.actuators), *(f"qpos:{n}" for n in log.channels.qpos)],
            "advice": "Log the command that was really sent, at every control period; add the log to the others.",
            "side_yaml": {"condition": "next experiment", **_controller(log)},
            "also": e.witnesses,
        },
    }
    if torque:
        notes["closed_loop"] = {
            "law": "u = ctrl + kp (ref - q) + kd (d ref/dt - dq/dt), clipped to the command limits; recommended",
            "kp": {log.actuators[i]: float(f"{d.kp[i]:.4g}") for i in torque},
            "kd": {log.actuators[i]: float(f"{d.kd[i]:.4g}") for i in torque},
            "note": "Log u as ctrl, with controller law torque: the diagnosis wants what was sent.",
        }
    return notes


def _controller(log: Any) -> dict[str, Any]:
    return {"controller": log.metadata["controller"]} if "controller" in log.metadata else {}


def _limits(e: Experiment) -> dict[str, Any]:
    assert e.chosen is not None
    limits, log = e.limits, e.chosen.played.log
    joints = {}
    for name in log.joints:
        v = log.channels.qvel.index(name) if name in log.channels.qvel else -1
        if v >= 0 and np.isfinite(limits.high[v]):
            joints[name] = {"range": _short(limits.low[v], limits.high[v]), "speed": _short(limits.speed[v])[0]}
    rows = zip(log.actuators, limits.command_low, limits.command_high, limits.effort, strict=True)
    actuators = {n: {"command": _short(low, high), "effort": _short(effort)[0]} for n, low, high, effort in rows}
    used = round(e.chosen.played.worst, 3)
    return {"joints": joints, "actuators": actuators, "largest_share_used": used, "from": limits.source}


def _short(*values: float) -> list[float]:
    return [float(f"{v:.6g}") for v in values]
