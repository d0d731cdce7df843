"""The folder of a diagnosis: results so far, the verdict as soon as it stands, at the end the result and its files."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray

from bayessim_mjx import atomic, urdf
from bayessim_mjx.diagnosis.correction import Found, Stepping, correction, stepping_of
from bayessim_mjx.diagnosis.experiment.propose import Experiment
from bayessim_mjx.diagnosis.findings import Findings, Observer
from bayessim_mjx.diagnosis.fitting import journal
from bayessim_mjx.diagnosis.fitting.robot import Robot, Source, one_line
from bayessim_mjx.diagnosis.phrases import notes, time_step
from bayessim_mjx.diagnosis.phrases.advice import MODEL
from bayessim_mjx.diagnosis.result import Diagnosis, load, plain
from bayessim_mjx.diagnosis.selection.numbers import Progress
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.statistics import of_one
from bayessim_mjx.diagnosis.summary import assemble
from bayessim_mjx.effects.support import native, storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.progress import Show

PRELIMINARY = "preliminary.json"  # results while the search goes on
SEARCH = "search_so_far"  # folder of the fits
COMMAND = "next_experiment.csv"


class Files(Observer):
    """Writes results into a folder, and passes progress on to the caller.

    Args:
        folder: it is made at the first file; None: nothing is written. about: entries of the report's header.
        progress, early: called as the methods of `Observer`; None: not called.
    """

    def __init__(
        self,
        folder: Path | None,
        about: Mapping[str, Any],
        progress: Progress | None = None,
        early: Callable[[Sequence[str]], None] | None = None,
    ) -> None:
        self.folder, self.about = folder, about
        self._progress, self._early = progress, early

    def progress(self, text: str, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(text, done, total)

    def note(self, text: str) -> None:
        if isinstance(self._progress, Show):
            self._progress.line(f"note: {text}")

    def early(self, lines: Sequence[str]) -> None:
        if self._early is not None:
            self._early(lines)

    @property
    def search(self) -> Path | None:
        """Folder for the fits, from which an interrupted search continues."""
        return None if self.folder is None else self.folder / SEARCH

    def known(self, setup: Setup, state: SearchState | None) -> None:
        """Write the results so far; they stay if the diagnosis is killed before its verdict."""
        if self.folder is not None:
            write_preliminary(self.folder / PRELIMINARY, self.about, setup, state)

    def verdict(self, found: Findings) -> None:
        """Write the verdict; it stays if the diagnosis is killed during maps and the next experiment."""
        if self.folder is not None:
            assemble.diagnosis_of(found, self.about).save(self.folder)
            (self.folder / PRELIMINARY).unlink(missing_ok=True)
            journal.remove(self.folder / SEARCH)

    def result(self, found: Findings) -> Diagnosis:
        """Make a Diagnosis of the findings; write the proposed experiment as a file that can be played."""
        proposal, name = found.part(Experiment), ""
        if self.folder is not None and proposal is not None and proposal.chosen is not None:
            source = str(self.folder / "diagnosis.json")
            name = write_command(self.folder / COMMAND, proposal, source).name
        return assemble.diagnosis_of(found, self.about, name)

    def insufficient(self, reason: str, notes: Sequence[str], robot: Robot) -> Diagnosis:
        """Make and write the result where nothing can be held out."""
        return self.whole(assemble.insufficient(reason, notes, self.about), robot)

    def whole(self, result: Diagnosis, robot: Robot) -> Diagnosis:
        """Write everything but the report; returns the result as it is loaded again."""
        if self.folder is None:
            return result
        result.save(self.folder)  # before anything that could fail: nothing computed is lost
        result = load(self.folder)
        if result.verdict != "insufficient_data":
            left_out = write_outputs(result, robot, self.folder)
            result = replace(result, warnings=[*result.warnings, *left_out])
            result.save(self.folder)
        return result


def write_preliminary(path: Path, about: Mapping[str, Any], setup: Setup, state: SearchState | None) -> None:
    """Write the results so far, whole or not at all; there is no verdict among them.

    Args:
        about: entries of the report's header; state: None before the first fit.
    """
    found = {"verdict": None, "about": dict(about), "before_simulation": notes.first_look(setup.look)}
    found |= {"warnings": list(setup.warnings)} | ({} if state is None else _so_far(state))
    path.parent.mkdir(parents=True, exist_ok=True)
    every = plain(found | {"windows": len(setup.fitter.simulator.windows)})
    atomic.write_text(path, json.dumps(every, indent=1, allow_nan=False) + "\n")


def _so_far(state: SearchState) -> dict[str, Any]:
    """Gaps in noise standard deviations, recalibrated parameters and the best models."""
    fit, calibrated = state.base.fit, state.gap(state.base)
    nominal, _ = state.nominal.quadratic()
    best = [
        {k: row[k] for k in ("label", "score", "se", "gap_closed", "parameters")} for row in assemble.ranking(state)
    ]
    return {
        "gap": {"nominal": of_one(float(nominal.c.sum()), calibrated.noise).rms, "calibrated": calibrated.rms},
        "parameters": dict(zip(fit.names, map(float, fit.values), strict=True)),
        "candidates": best,
    }


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
            "note": "Log u as ctrl, with controller law torque: the diagnosis needs the command that was sent.",
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


# The corrected simulator as files: effects.yaml, the model for plain MuJoCo, and a URDF where it came from one


URDF = "model_with_effects.urdf"
# what a URDF has elements for: effects, and attributes of recalibrated parameters
IN_URDF = ("coulomb_friction", "viscous_friction", "payload", "inertial_parameters")
CALIBRATED_IN_URDF = ("damping", "friction", "mass", "inertia", "com_x", "com_y", "com_z")


def write_outputs(diagnosis: Found, robot: Robot, folder: str | Path) -> list[str]:
    """Write effects.yaml and, where the robot has a specification, model_with_effects.xml; of a URDF, a URDF too.

    Returns:
        One sentence for each thing that a file leaves out because its format has no element for it.
    """
    folder = Path(folder)
    found = correction(diagnosis, robot.space)
    effects, calibrated = found.effects, ParameterSpace(found.calibrated)
    every = [*calibrated.parameters, *(p for e in effects for p in e.space().parameters)]
    identified = {p.name: (p.mean, p.sd) for p in every if p.mean is not None and p.sd is not None}
    stepping = stepping_of(diagnosis)
    _add_stepping(storage.write(folder / "effects.yaml", effects, identified, calibrated), stepping)
    for name in (MODEL, URDF):  # of an earlier diagnosis
        (folder / name).unlink(missing_ok=True)
    if robot.spec is None:
        return [f"{MODEL} is not written: a compiled model has no specification; give its MJCF or MjSpec"]
    source = robot.spec()
    spec, missing = native.write_model(source, calibrated, calibrated.nominal, effects)
    spec, how = _stepping(_friction_acting(_at_home(spec, source.modelfiledir)), stepping)
    left_out = "".join(f"  {sentence}\n" for sentence in missing)
    note = f"<!-- Not in this model:\n{left_out.replace('--', '- -')}-->\n" if missing else ""
    (folder / MODEL).write_text(how + note + spec.to_xml(), encoding="utf-8")
    try:
        model = mujoco.MjModel.from_xml_path(str(folder / MODEL))
    except ValueError as error:
        return [f"{MODEL} does not load, use effects.yaml: {one_line(error)}"]
    said = [f"{MODEL} leaves out {sentence}" for sentence in missing]
    if robot.urdf is None:
        return said
    (folder / URDF).write_text(urdf.corrected(robot.urdf, source.compile(), model), encoding="utf-8")
    lacks = [f"{e.name} at {', '.join(e.places())}" for e in effects if e.name not in IN_URDF]
    lacks += [p.name for p in found.calibrated if p.attribute not in CALIBRATED_IN_URDF]
    has = "a URDF has friction and damping of joints and inertias of links"
    return [*said, *([f"{URDF} leaves out {', '.join(lacks)}: {has}"] if lacks else [])]


def _add_stepping(file: Path, found: Stepping | None) -> None:
    """Add to an effects.yaml the integrator and the time step that its numbers belong to."""
    if found is not None:
        step = {"simulated": {"integrator": found.integrator, "timestep": _rounded(found.timestep)}}
        said = "".join(f"# {line}\n" for line in _written(found).split(". "))
        file.write_text(file.read_text(encoding="utf-8") + said + yaml.safe_dump(step, sort_keys=False), "utf-8")


def _stepping(spec: mujoco.MjSpec, found: Stepping | None) -> tuple[mujoco.MjSpec, str]:
    """Return the specification with the integrator and the time step of the diagnosis, and a comment that says so."""
    if found is None:
        return spec, ""
    spec.option.integrator, spec.option.timestep = mujoco.mjtIntegrator(found.number), _rounded(found.timestep)
    return spec, f"<!-- {_written(found)} -->\n"


def _written(found: Stepping) -> str:
    return time_step.written(found.integrator, found.timestep, found.own, found.own_step)


def _rounded(seconds: float) -> float:
    return float(f"{seconds:.9g}")


def _friction_acting(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Native friction is a constraint: where constraints are off as a whole, all others are now off one by one."""
    off = mujoco.mjtDisableBit
    if any(joint.frictionloss > 0 for joint in spec.joints):
        flags = int(spec.option.disableflags) & ~int(off.mjDSBL_FRICTIONLOSS)
        if flags & int(off.mjDSBL_CONSTRAINT):
            others = int(off.mjDSBL_CONTACT) | int(off.mjDSBL_LIMIT) | int(off.mjDSBL_EQUALITY)
            flags = flags & ~int(off.mjDSBL_CONSTRAINT) | others
        spec.option.disableflags = flags
    return spec


def _at_home(spec: mujoco.MjSpec, folder: str) -> mujoco.MjSpec:
    """Return the specification with its meshes and textures where they are, wherever its XML will lie."""
    assets = [*spec.meshes, *spec.hfields, *spec.skins]
    if not any(asset.file for asset in (*assets, *spec.textures)):
        return spec
    home = Path(folder).resolve()  # "": of a file that was named without its folder
    meshes, textures = spec.meshdir, spec.texturedir
    spec.meshdir, spec.texturedir = str((home / meshes).resolve()), str((home / textures).resolve())
    for asset, below in [*((asset, meshes) for asset in assets), *((texture, textures) for texture in spec.textures)]:
        # in full where it does not lie in the model's own folder of assets: an attached model's
        if folder and asset.file and not (home / below / asset.file).is_file():
            found = [path for path in home.rglob(Path(asset.file).name) if path.match(asset.file)]
            asset.file = str(found[0]) if len(found) == 1 else asset.file
    return spec


def header(
    robot: Robot,
    model: Source,
    logs: Sequence[str | Path | Log],
    recorded: Sequence[Log],
    stated: Sequence[Sequence[str]] = ((), (), ()),
) -> dict[str, Any]:
    """Return entries of the report's header.

    Args:
        stated: texts of --accuracy, --payload and --tolerance.
    """
    return {
        "robot": robot.name,
        "model": str(model) if isinstance(model, str | Path) else robot.name,
        "data": [log.name if isinstance(log, Log) else str(log) for log in logs],
        "logs": len(recorded),
        "seconds": float(sum(log.duration for log in recorded)),
        "stated": dict(zip(("accuracy", "payload", "tolerance"), map(list, stated), strict=True)),
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }
