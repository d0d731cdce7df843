"""Public logs of robots with several joints, as `diagnose` reads them, and the fits that were published with them.

    python benchmarks/diagnosis/public_logs.py SET --clone REPOSITORY --out DIR

writes DIR/model.xml, DIR/logs/ and DIR/published.json.

`--clone` is a clone of the repository that holds the logs. Nothing of it is part of this project:

    go2, aliengo, z1  github.com/iit-DLSLab/simple-robot-identification-isaaclab   legs on a stand, an arm
    ur10e             github.com/shamilmamedov/dynamic_calibration                 an arm that carries 2.805 kg
    double_pendulum   github.com/dfki-ric-underactuated-lab/double_pendulum        design C.1

The model is what a user has: kinematics and masses, no dry friction. What was fitted to the logs by others is not in
it, but for the UR10e: there it is the robot as identified without its load. Open `published.json` after the verdict.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from bayessim_mjx.logs.importers.pace import arrays

CONDITIONS = 6  # blocks in time of the single recordings, held out in turn


class Logs:
    """What one data set is converted to: an MJCF, logs and the published numbers."""

    def __init__(self, out: Path) -> None:
        self.out = out
        (out / "logs").mkdir(parents=True, exist_ok=True)

    def log(self, name: str, columns: dict[str, np.ndarray], **metadata: Any) -> None:
        """One recording; the columns are named as in the MJCF."""
        table = np.stack([np.asarray(v, float) for v in columns.values()], axis=1)
        path = self.out / "logs" / f"{name}.csv"
        np.savetxt(path, table, fmt="%.7g", delimiter=",", header=",".join(columns), comments="")
        if metadata:
            path.with_suffix(".yaml").write_text(yaml.safe_dump(metadata))

    def done(self, model: str, published: dict[str, Any]) -> None:
        (self.out / "model.xml").write_text(model)
        (self.out / "published.json").write_text(json.dumps(published, indent=1))


def bare(tree: ElementTree.Element, keep: Sequence[str]) -> None:
    """Drops pictures, contacts and what belongs to them; of the joints those in `keep` alone are left free."""
    for tag in ("asset", "default", "sensor", "keyframe", "contact", "equality", "actuator", "tendon"):
        for found in tree.findall(tag):
            tree.remove(found)
    for parent in list(tree.iter()):
        parent.attrib.pop("childclass", None)
        for child in list(parent):
            loose = child.tag == "joint" and child.get("name") not in keep
            if child.tag in ("geom", "site", "camera", "light", "freejoint", "replicate") or loose:
                parent.remove(child)
            elif child.tag == "joint":
                child.attrib.pop("class", None)


def held_in_place(
    path: Path, joints: Sequence[str], root: str, axes: dict[str, str], **nominal: float
) -> tuple[str, dict]:
    """The part of an MJCF below `root`, with motors, on a fixed base; and the fitted joint numbers that it had."""
    tree = ElementTree.parse(path).getroot()
    bare(tree, joints)
    top = next(b for b in tree.iter("body") if b.get("name") == root)
    fitted: dict[str, dict[str, float]] = {}
    for joint in top.iter("joint"):
        name = str(joint.get("name"))
        fitted[name] = {k: float(joint.attrib.pop(k, 0.0)) for k in ("damping", "armature", "frictionloss")}
        for limit in ("range", "limited"):
            joint.attrib.pop(limit, None)
        joint.attrib.setdefault(
            "axis", axes.get(name.split("_")[-2] if "_" in name else name, joint.get("axis", "0 0 1"))
        )
        joint.attrib |= {k: f"{v:g}" for k, v in nominal.items()}
    body = ElementTree.tostring(top, encoding="unicode")
    motors = "".join(f'<motor name="{j}" joint="{j}"/>' for j in joints)
    option = '<option timestep="0.0025" integrator="implicitfast"/><compiler angle="radian" autolimits="true"/>'
    return f"<mujoco>{option}<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>", fitted


def chirps(clone: Path, out: Logs, robot: str) -> None:
    """Targets of position control at 200 Hz on a robot that cannot move its base."""
    data = arrays(clone / f"datasets/{robot}/traj_0.pt")
    path = clone / f"robot_model/{robot}/{robot}.xml"
    if robot == "z1":
        joints = [f"joint{i}" for i in range(1, 7)]
        model, fitted = held_in_place(path, joints, "link00", {}, damping=1, armature=0.1)
    else:
        joints = [f"FL_{part}_joint" for part in ("hip", "thigh", "calf")]
        axes = {"hip": "1 0 0", "thigh": "0 1 0", "calf": "0 1 0"}
        model, fitted = held_in_place(path, joints, "FL_hip", axes, damping=0.1, armature=0.01)
    law = {
        j: {"law": "position", "kp": float(k), "kd": float(d)}
        for j, k, d in zip(joints, data["kp"], data["kd"], strict=False)
    }
    columns = {"time": np.arange(len(data["time"])) / 200.0}
    for i, j in enumerate(joints):
        columns |= {
            f"ctrl:{j}": data["des_dof_pos"][:, i],
            f"qpos:{j}": data["dof_pos"][:, i],
            f"qvel:{j}": data["dof_vel"][:, i],
        }
    for k, rows in enumerate(np.array_split(np.arange(len(columns["time"])), CONDITIONS)):
        out.log(f"block{k}", {n: v[rows] for n, v in columns.items()}, controller=law, condition=f"block {k}")
    out.done(model, {"fitted by mujoco.sysid to the same log": fitted})


UR_GAINS = (10.0000, 10.6956, 8.4566, 9.0029, 9.4800, 10.1232)  # N m / A
UR_ARMATURE = (0.0, 3.7434, 0.0, 0.0708, 0.2342, 0.4365)
UR_VISCOUS = (21.256, 20.221, 10.378, 3.575, 2.491, 3.026)
UR_COULOMB = (12.548, 13.266, 4.994, 1.998, 2.690, 2.298)
UR_LINKS = (  # name, position and rotation in its parent, axis, mass, centre of mass (the manufacturer's description)
    ("shoulder_pan", "0 0 .181", "0 0 0", "0 0 1", 7.778, "0 0 0"),
    ("shoulder_lift", "0 .176 0", "0 1.570796 0", "0 1 0", 12.93, "0 0 .3065"),
    ("elbow", "0 -.137 .613", "0 0 0", "0 1 0", 3.87, "0 0 .2855"),
    ("wrist_1", "0 0 .571", "0 1.570796 0", "0 1 0", 1.96, "0 .135 0"),
    ("wrist_2", "0 .135 0", "0 0 0", "0 0 1", 1.96, "0 0 .12"),
    ("wrist_3", "0 0 .12", "0 0 0", "0 1 0", 0.202, "0 .092 0"),
)  # fmt: skip
UR_INERTIA = (  # about the centre of mass
    "0.0315 0.0315 0.0219", "0.4231 0.4231 0.0364", "0.1106 0.1106 0.0109",
    "0.00511 0.00511 0.00551", "0.00511 0.00511 0.00551", "0.000144 0.000205 0.000144",
)  # fmt: skip


def ur10e(clone: Path, out: Logs) -> None:
    """Currents of the drives as commands, at 100 Hz; two recordings with the load, cut into blocks."""
    body = "".join(
        f'<body name="{n}_link" pos="{p}" euler="{r}"><inertial pos="{c}" mass="{m}" diaginertia="{i}"/>'
        f'<joint name="{n}" axis="{a}" damping="{d}" armature="{max(j, 0.01)}" frictionloss="{f}"/>'
        for (n, p, r, a, m, c), i, d, j, f in zip(
            UR_LINKS, UR_INERTIA, UR_VISCOUS, UR_ARMATURE, UR_COULOMB, strict=True
        )
    )
    names = [link[0] for link in UR_LINKS]
    motors = "".join(f'<motor name="{n}" joint="{n}" gear="{g}"/>' for n, g in zip(names, UR_GAINS, strict=True))
    option = '<option timestep="0.002" integrator="implicitfast"/><compiler angle="radian"/>'
    model = f"<mujoco>{option}<worldbody>{body}{'</body>' * 6}</worldbody><actuator>{motors}</actuator></mujoco>"
    for k, (name, first, last) in enumerate((("14harm50secLoad", 308, 5071), ("15harm50secLoad", 400, 5000))):
        table = np.genfromtxt(next(clone.glob(f"**/*{name}.csv")), delimiter=",", usecols=range(1 + 3 * 6))[first:last]
        for i, rows in enumerate(np.array_split(table, CONDITIONS // 2)):
            columns = {"time": rows[:, 0] - rows[0, 0]}
            for j, joint in enumerate(names):
                columns |= {
                    f"ctrl:{joint}": rows[:, 13 + j],
                    f"qpos:{joint}": rows[:, 1 + j],
                    f"qvel:{joint}": rows[:, 7 + j],
                }
            out.log(f"load{k}_{i}", columns, condition=f"load {k} {i}")
    out.done(model, {"load, weighed": "2.805 kg at the tool (wrist_3_link)"})


DESIGN = "data/system_identification/identified_parameters/design_C.1"


def double_pendulum(clone: Path, out: Logs) -> None:
    """Torques of two quasi-direct drives; every recording is a condition of its own."""
    published = {
        p.parent.name: yaml.safe_load(p.read_text()) for p in sorted((clone / DESIGN).glob("*/model_parameters.yml"))
    }
    rods = (
        (0.2, 0.52, 0.2, 0.032),
        (0.3, 0.63, 0.26, 0.051),
    )  # length, mass, centre of mass m, inertia about the joint: CAD
    bodies = "".join(
        f'<body name="link{i + 1}" pos="0 0 {-rods[0][0] * i:g}">'
        f'<joint name="joint{i + 1}" axis="0 -1 0" armature="0.0023"/>'
        f'<inertial pos="0 0 {-c}" mass="{m}" diaginertia="{own:.4f} {own:.4f} 0.0005"/>'
        for i, (_, m, c, j) in enumerate(rods)
        for own in (max(j - m * c * c, 4e-3),)
    )
    motors = '<motor name="shoulder" joint="joint1"/><motor name="elbow" joint="joint2"/>'
    option = '<option timestep="0.001" integrator="implicitfast"/>'
    for path in sorted((clone / "data/experiment_records/design_C.1/sys_id/20230629").glob("*/trajectory.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        columns = {"time": table["time"]}
        for i, motor in enumerate(("shoulder", "elbow"), 1):
            columns |= {f"ctrl:{motor}": table[f"tau_con{i}"], f"qpos:joint{i}": table[f"pos_meas{i}"]}
            columns |= {f"qvel:joint{i}": table[f"vel_meas{i}"], f"effort:{motor}": table[f"tau_meas{i}"]}
        out.log(path.parent.name, columns, effort_unit="N m")
    model = f"<mujoco>{option}<worldbody>{bodies}</body></body></worldbody><actuator>{motors}</actuator></mujoco>"
    out.done(model, published)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", choices=("go2", "aliengo", "z1", "ur10e", "double_pendulum"))
    parser.add_argument("--clone", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    out = Logs(args.out)
    if args.set == "ur10e":
        ur10e(args.clone, out)
    elif args.set == "double_pendulum":
        double_pendulum(args.clone, out)
    else:
        chirps(args.clone, out, args.set)


if __name__ == "__main__":
    main()
