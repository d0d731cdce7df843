"""Published logs of real robots as models, parameters and logs of ours; the NOTES.md of the data tell their source."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

FULL_TURN, FULL_DUTY = 4096, 256 * 885  # the XL330's encoder and the unit of its gain

EMPS = """<mujoco model="emps"><option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
<worldbody><body name="carriage"><joint name="slide" type="slide" axis="1 0 0"/>
<geom type="box" size=".1 .1 .1" mass="90"/></body></worldbody>
<actuator><motor name="motor" joint="slide"/></actuator></mujoco>"""
VISCOUS = """actor_params:
  carriage:
    rigid_body_properties: {mass: {range: [0.8, 1.2], operation: scaling}}
    dof_properties: {damping: {range: [0, 500], operation: absolute}}
"""
XL330 = """<mujoco model="xl330"><option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
<worldbody><body name="load"><joint name="servo" axis="0 1 0" damping=".005" armature=".0018"/>
<geom type="sphere" size=".01" pos="0 0 -.1" mass=".49"/></body></worldbody><actuator><general name="motor"
joint="servo" gaintype="fixed" gainprm=".125" biastype="affine" biasprm="0 0 -.047"/></actuator></mujoco>"""
MOTOR = """actor_params:
  load:
    dof_properties:
      damping: {range: [0.0005, 0.03], operation: absolute, distribution: loguniform}
      armature: {range: [0.0005, 0.006], operation: absolute, distribution: loguniform}
    actuator_properties:
      gain: {range: [0.06, 0.25], operation: absolute}
      kv: {range: [0.01, 0.15], operation: absolute}
"""
DFKI = """<mujoco model="dfki"><option><flag contact="disable"/></option><worldbody><body name="pendulum">
<joint name="hinge" axis="0 1 0"/><geom type="sphere" size=".05" mass=".546" pos="0 0 -.5"/>
<geom type="capsule" size=".01" fromto="0 0 0 0 0 -.5" mass=".13"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
COLUMNS = """ctrl: {motor: torque}
qpos: {hinge: position}
qvel: {hinge: velocity}
"""


def _log(path: Path, columns: dict[str, Any], metadata: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.stack(list(columns.values()), 1), "%.10g", ",", header=",".join(columns), comments="")
    path.with_suffix(".yaml").write_text(json.dumps(metadata, indent=1))  # JSON is YAML


def convert_emps(data: Path, out: Path) -> None:
    """logs/: the identification log; validation/: the log with pulses, which the diagnosis never sees.

    The command is the drive's force gtau vir. It holds the reaction to the pulses, not the pulses: those were added in
    the digital loop ahead of `vir` (with them added once more the published model fits worse, 6.2 % against 4.3 %).
    """
    for file, folder in (("DATA_EMPS", "logs"), ("DATA_EMPS_PULSES", "validation")):
        raw = {k: np.squeeze(v) for k, v in loadmat(data / "emps" / f"{file}.mat").items() if k[0] != "_"}
        columns = {"time": raw["t"], "ctrl:motor": float(raw["gtau"]) * raw["vir"], "qpos:slide": raw["qm"]}
        _log(out / folder / f"{file}.csv", columns, {"condition": folder})
    (out / "model.xml").write_text(EMPS)
    (out / "viscous.yaml").write_text(VISCOUS)


def convert_xl330(data: Path, out: Path) -> None:
    """The firmware's position law is known (its duty was logged); the condition is its gain."""
    for path in sorted((data / "xl330_servo" / "raw").glob("*.json")):
        run = json.loads(path.read_text())
        rows = {k: np.array([float(e[k]) for e in run["entries"]]) for k in run["entries"][0]}
        columns = {
            "time": rows["timestamp"],
            "ctrl:motor": rows["goal_position"],
            "qpos:servo": rows["position"],
            "enabled:motor": rows["torque_enable"],
            "voltage": rows["input_volts"],
            "temperature": rows["temp"],
        }
        kp = run["vin"] * run["kp"] * FULL_TURN / (2 * np.pi) / FULL_DUTY
        law = {"law": "position", "kp": kp, "kd": 0, "limit": run["vin"]}
        name = f"kp{run['kp']}_{run['trajectory']}.csv"
        _log(out / "logs" / name, columns, {"condition": f"kp{run['kp']}", "controller": law})
    (out / "model.xml").write_text(XL330)
    (out / "params.yaml").write_text(MOTOR)


def convert_dfki(data: Path, out: Path) -> None:
    """The measured runs as they are, read by a map."""
    (out / "logs").mkdir(parents=True, exist_ok=True)
    for path in sorted((data / "dfki_simple_pendulum").glob("*measured*.csv")):
        shutil.copy(path, out / "logs")
    (out / "model.xml").write_text(DFKI)
    (out / "map.yaml").write_text(COLUMNS)
