"""Logs of a floating robot whose base nobody measured: encoders, and an inertial measurement unit on its trunk.

Plain MuJoCo C at 0.5 ms, apart from the library. `write` makes a folder with the nominal model, logs and the truth:

    python benchmarks/diagnosis/quadruped.py OUT --robot bars --place ground --fault coulomb
"""

import argparse
import csv
import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np

STEP = 5e-4  # s, of the reality
MODEL_STEP = 2e-3  # s, of the nominal model
SETTLE = 1.0  # s before a log begins
SERVO = (120.0, 3.0)  # N m/rad, N m s/rad of the position servos of legs


@dataclasses.dataclass(frozen=True)
class Unit:
    """Errors of the sensors.

    Attributes:
        gyro_bias, gyro: bias and noise of the gyroscope, rad/s; accel_bias, accel: of the accelerometer, m/s^2.
        tilt: rad, slow errors of the orientation; encoder: rad, a tenth of it in m.
    """

    gyro_bias: tuple[float, float, float] = (0.02, -0.012, 0.008)
    accel_bias: tuple[float, float, float] = (0.08, -0.05, 0.1)
    gyro: float = 2e-3
    accel: float = 3e-2
    tilt: float = 4e-3
    encoder: float = 3e-4


@dataclasses.dataclass(frozen=True)
class Fault:
    """What the nominal model lacks: effect of the library, where, and its size."""

    effect: str = ""
    where: str = ""
    size: float = 0.0


FAULTS = {
    "stool": {
        "null": Fault(),
        "coulomb": Fault("coulomb_friction", "ankle", 2.0),
        "gain": Fault("actuator_gain", "lift", 0.75),
        "delay": Fault("actuator_delay", "lift", 0.03),
        "payload": Fault("payload", "trunk", 1.5),
        "armature": Fault("armature", "lift", 3.0),
    },
    "bars": {
        "null": Fault(),
        "coulomb": Fault("coulomb_friction", "front_knee", 1.0),
        "gain": Fault("actuator_gain", "rear_hip", 0.75),
        "delay": Fault("actuator_delay", "front_hip", 0.012),
        "payload": Fault("payload", "trunk", 1.5),
        "armature": Fault("armature", "rear_knee", 0.03),
    },
    "quadruped": {
        "null": Fault(),
        "coulomb": Fault("coulomb_friction", "FL_knee", 1.0),
        "gain": Fault("actuator_gain", "RR_hip", 0.75),
        "delay": Fault("actuator_delay", "FR_knee", 0.012),
        "payload": Fault("payload", "trunk", 3.0),
        "armature": Fault("armature", "RL_hip", 0.03),
    },
}


def model_of(robot: str, place: str) -> str:
    """MJCF of the nominal robot: `ground` floats over a plane, `stand` hangs fixed."""
    if robot == "stool":
        return _stool(place)
    names, legs = _bars() if robot == "bars" else _quadruped()
    kp, kv = SERVO
    joint = '<freejoint name="root"/>' if place == "ground" else ""
    drives = "".join(f'<position name="{n}" joint="{n}" kp="{kp}" kv="{kv}" forcerange="-60 60"/>' for n in names)
    box = ("0.16 0.09 0.04", 4.0) if robot == "bars" else ("0.2 0.09 0.05", 7.0)
    return f"""<mujoco model="{robot}"><option timestep="{MODEL_STEP}"/>
<default><joint damping="0.3" armature="0.01"/><geom contype="0" conaffinity="1" friction="1"/></default>
<worldbody><geom name="floor" type="plane" size="5 5 .1" contype="1"/>
<body name="trunk" pos="0 0 {1.0 if place == "stand" else 0.35}">{joint}
<geom type="box" size="{box[0]}" mass="{box[1]}" conaffinity="0"/>
<site name="imu" pos="0.05 0.01 0.03" euler="0 0 90"/>{legs}</body></worldbody>
<actuator>{drives}</actuator>
<sensor><gyro name="imu_gyro" site="imu"/><accelerometer name="imu_accel" site="imu"/>
<framequat name="imu_quat" objtype="site" objname="imu"/></sensor></mujoco>"""


def _stool(place: str) -> str:
    """A trunk over a plate on three feet, with a lift and an ankle: the smallest floating robot that moves."""
    joint = '<freejoint name="root"/>' if place == "ground" else ""
    feet = "".join(
        f'<geom name="foot{i}" type="sphere" size=".02" pos="{x} {y} -.03" mass=".02"/>'
        for i, (x, y) in enumerate(((0.16, 0.0), (-0.1, 0.13), (-0.1, -0.13)))
    )
    option = 'timestep="0.005" integrator="implicitfast" iterations="8" ls_iterations="8"'
    return f"""<mujoco model="stool"><option {option}/>
<default><geom contype="0" conaffinity="1" friction="1"/></default>
<worldbody><geom name="floor" type="plane" size="5 5 .1" contype="1"/>
<body name="trunk" pos="0 0 {1.0 if place == "stand" else 0.35}">{joint}
<geom type="box" size=".1 .08 .05" mass="4" conaffinity="0"/><site name="imu" pos="0.05 0.01 0.03" euler="0 0 90"/>
<body name="column" pos="0 0 -.1"><joint name="lift" type="slide" axis="0 0 1" damping="30" armature="1"/>
<geom type="capsule" size=".015" fromto="0 0 0 0 0 -.15" mass=".5" conaffinity="0"/>
<body name="plate" pos="0 0 -.16"><joint name="ankle" axis="0 1 0" damping=".4" armature=".02"/>
<geom type="box" size=".12 .1 .01" mass=".8" conaffinity="0"/>{feet}</body></body></body></worldbody>
<actuator><position name="lift" joint="lift" kp="3000" kv="120"/><position name="ankle" joint="ankle" kp="150" kv="6"/>
</actuator><sensor><gyro name="imu_gyro" site="imu"/><accelerometer name="imu_accel" site="imu"/>
<framequat name="imu_quat" objtype="site" objname="imu"/></sensor></mujoco>"""


def _body(name: str, pos: str, joint: str, axis: str, inner: str) -> str:
    return f'<body name="{name}" pos="{pos}"><joint name="{joint}" axis="{axis}"/>{inner}</body>'


def _limb(length: float, mass: float, inner: str) -> str:
    return f'<geom type="capsule" size=".012" fromto="0 0 0 0 0 -{length}" mass="{mass}" conaffinity="0"/>{inner}'


def _bars() -> tuple[list[str], str]:
    """A front and a rear leg of two joints, each with a bar of two balls across as its foot."""
    names, out = [], ""
    for side, x in (("front", 0.13), ("rear", -0.13)):
        feet = "".join(
            f'<geom name="{side}_{k}" type="sphere" size=".018" pos="0 {y} -.15" mass=".06"/>'
            for k, y in (("left", 0.1), ("right", -0.1))
        )
        knee = _body(f"{side}_shank", "0 0 -.15", f"{side}_knee", "0 1 0", _limb(0.15, 0.25, feet))
        out += _body(f"{side}_thigh", f"{x} 0 0", f"{side}_hip", "0 1 0", _limb(0.15, 0.4, knee))
        names += [f"{side}_hip", f"{side}_knee"]
    return names, out


def _quadruped() -> tuple[list[str], str]:
    """Four legs of three joints: abduction, hip and knee."""
    names, out = [], ""
    for leg, x, y in (("FL", 0.18, 0.1), ("FR", 0.18, -0.1), ("RL", -0.18, 0.1), ("RR", -0.18, -0.1)):
        foot = f'<geom name="{leg}_foot" type="sphere" size=".02" pos="0 0 -.18" mass=".06"/>'
        knee = _body(f"{leg}_shank", "0 0 -.18", f"{leg}_knee", "0 1 0", _limb(0.18, 0.2, foot))
        hip = _body(f"{leg}_thigh", f"0 {np.sign(y) * 0.05} 0", f"{leg}_hip", "0 1 0", _limb(0.18, 0.7, knee))
        abad = f'<geom type="sphere" size=".03" mass=".5" conaffinity="0"/>{hip}'
        out += _body(f"{leg}_side", f"{x} {y} 0", f"{leg}_abad", "1 0 0", abad)
        names += [f"{leg}_abad", f"{leg}_hip", f"{leg}_knee"]
    return names, out


def with_fault(xml: str, fault: Fault) -> mujoco.MjModel:
    """Return the reality: the fault, a finer step."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.timestep = STEP
    if fault.effect == "coulomb_friction":
        spec.joint(fault.where).frictionloss = fault.size
    if fault.effect == "armature":
        spec.joint(fault.where).armature += fault.size
    if fault.effect == "payload":
        body = spec.body(fault.where)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], pos=[0.04, 0, 0.05], mass=fault.size,
            contype=0, conaffinity=0,
        )  # fmt: skip
    if fault.effect == "actuator_gain":
        drive = spec.actuator(fault.where)
        drive.gainprm = fault.size * np.array(drive.gainprm)
        drive.biasprm = fault.size * np.array(drive.biasprm)
        drive.forcerange = fault.size * np.array(drive.forcerange)
    return spec.compile()


def targets(robot: str, place: str, seed: int, names: list[str]):  # noqa: ANN201
    """Return a function of time: targets `[nu]` rad of squats and shifts of weight, or of free legs on a stand."""
    rng = np.random.default_rng(seed)
    if robot == "stool":
        size = np.array([0.035, 0.07 if place == "ground" else 0.3])
        rates, angle = 2 * np.pi * rng.uniform(0.4, 1.7, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))
        return lambda t: min(1.0, max(0.0, t + SETTLE - 0.3) / 0.7) * size * np.sin(rates * t + angle).sum(0) / 2
    bend, joints = 0.55, len(names)
    pace = 2 * np.pi * rng.uniform(0.35, 0.6)
    phase = rng.uniform(0, 2 * np.pi, 6)
    own_phase, own_pace = rng.uniform(0, 2 * np.pi, joints), 2 * np.pi * rng.uniform(0.8, 1.8, joints)
    own = (0.04 if robot == "bars" else 0.02) if place == "ground" else 0.25
    rear = np.array([n.startswith(("rear", "R")) for n in names])
    left = np.array([n[1:2] == "L" for n in names])

    def at(t: float) -> np.ndarray:
        ease = min(1.0, max(0.0, t + SETTLE - 0.3) / 0.7)
        depth = bend + ease * (0.16 * np.sin(pace * t + phase[0]) + 0.07 * np.sin(2.3 * pace * t + phase[1]))
        shift = ease * (0.09 if robot == "bars" else 0.05) * np.sin(1.4 * pace * t + phase[2])
        pitch = ease * 0.07 * np.sin(1.9 * pace * t + phase[3])
        roll = ease * 0.06 * np.sin(1.2 * pace * t + phase[4])
        out = np.zeros(joints)
        for i, name in enumerate(names):
            d = depth + pitch * (1 if rear[i] else -1) + (roll * (1 if left[i] else -1) if robot != "bars" else 0.0)
            out[i] = {"hip": d + shift, "knee": -2 * d, "abad": 0.7 * shift * np.sin(pace * t)}[name.rsplit("_", 1)[1]]
        return out + ease * own * np.sin(own_pace * t + own_phase)

    return at


def run(xml: str, robot: str, place: str, fault: Fault, seed: int, seconds: float, unit: Unit) -> dict[str, np.ndarray]:
    """One run: encoders and commands at 100 Hz (stool: 50 Hz), the unit twice as fast; and the base's true motion."""
    model = with_fault(xml, fault)
    data, rng = mujoco.MjData(model), np.random.default_rng(1000 + seed)
    names = [model.actuator(i).name for i in range(model.nu)]
    want, adr = targets(robot, place, seed, names), [model.joint(n).qposadr[0] for n in names]
    data.qpos[adr] = want(-SETTLE)
    if place == "ground":
        mujoco.mj_forward(model, data)
        balls = [g for g in range(model.ngeom) if model.geom_type[g] == 2 and model.geom_conaffinity[g]]
        data.qpos[2] -= min(data.geom_xpos[g][2] - model.geom_size[g][0] for g in balls)
    late = round(fault.size / STEP) if fault.effect == "actuator_delay" else 0
    slow = names.index(fault.where) if late else 0
    sent: list[np.ndarray] = []
    rows: dict[str, list] = {k: [] for k in ("time", "ctrl", "qpos", "gyro", "accel", "quat", "pose", "twist")}
    begin, each, total = (
        round(SETTLE / STEP),
        round((0.02 if robot == "stool" else 0.01) / STEP),
        round((SETTLE + seconds) / STEP),
    )
    command = want(-SETTLE)
    encoder = unit.encoder * np.array([0.1 if model.jnt_type[model.joint(n).id] == 2 else 1.0 for n in names])
    for k in range(total):
        if k % each == 0:
            command = want(k * STEP - SETTLE)
        sent.append(command)
        data.ctrl[:] = command
        if late:
            data.ctrl[slow] = sent[max(0, k - late)][slow]
        if k >= begin and (k - begin) % (each // 2) == 0:
            mujoco.mj_forward(model, data)
            whole = (k - begin) % each == 0
            rows["time"].append((k - begin) * STEP)
            rows["ctrl"].append(command if whole else np.full(len(names), np.nan))
            noisy = data.qpos[adr] + encoder * rng.normal(size=len(names))
            rows["qpos"].append(noisy if whole else np.full(len(names), np.nan))
            seen = {n: data.sensor(f"imu_{n}").data.copy() for n in ("gyro", "accel", "quat")}
            rows["gyro"].append(seen["gyro"] + unit.gyro_bias + unit.gyro * rng.normal(size=3))
            rows["accel"].append(seen["accel"] + unit.accel_bias + unit.accel * rng.normal(size=3))
            rows["quat"].append(_tilted(seen["quat"], unit.tilt * np.sin(0.7 * k * STEP + np.array([seed, 1.0, 2.0]))))
            rows["pose"].append(data.qpos[:7].copy() if place == "ground" else np.array([0, 0, 1, 1, 0, 0, 0.0]))
            rows["twist"].append(data.qvel[:6].copy() if place == "ground" else np.zeros(6))
        mujoco.mj_step(model, data)
    return {"names": np.array(names), **{k: np.array(v) for k, v in rows.items()}}


def _tilted(quat: np.ndarray, by: np.ndarray) -> np.ndarray:
    out = quat.copy()
    mujoco.mju_quatIntegrate(out, by, 1.0)
    return out


def write_csv(path: Path, found: dict[str, np.ndarray], orientation: bool) -> None:
    """Rows at the unit's rate; encoders and commands have every other one."""
    kinds = [("ctrl", None), ("qpos", None), ("gyro:imu_gyro", "gyro"), ("accel:imu_accel", "accel")]
    kinds += [("quat:imu_quat", "quat")] if orientation else []
    head, columns = ["time"], [found["time"]]
    for label, key in kinds:
        values = found[key or label]
        head += (
            [f"{label}:{n}" for n in found["names"]]
            if key is None
            else [f"{label}[{i}]" for i in range(values.shape[1])]
        )
        columns += list(values.T)
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(head)
        for row in zip(*columns, strict=True):
            out.writerow(["" if np.isnan(x) else f"{x:.7g}" for x in row])


def write(
    out: Path, robot: str, place: str, fault: str, runs: int, seconds: float, orientation: bool, seed: int
) -> None:
    """Write `robot.xml`, `logs/run*.csv`, `truth.json` and the base's true motion `base/run*.npz`."""
    (out / "logs").mkdir(parents=True, exist_ok=True)
    (out / "base").mkdir(exist_ok=True)
    xml, what, unit = model_of(robot, place), FAULTS[robot][fault], Unit()
    (out / "robot.xml").write_text(xml)
    for i in range(runs):
        found = run(xml, robot, place, what, seed + i, seconds, unit)
        write_csv(out / "logs" / f"run{i}.csv", found, orientation)
        np.savez(out / "base" / f"run{i}.npz", time=found["time"], pose=found["pose"], twist=found["twist"])
    (out / "truth.json").write_text(json.dumps({"fault": dataclasses.asdict(what), "unit": dataclasses.asdict(unit)}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--robot", choices=FAULTS, default="stool")
    parser.add_argument("--place", choices=("ground", "stand"), default="ground")
    parser.add_argument("--fault", choices=FAULTS["stool"], default="null")
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--orientation", action="store_true", help="the unit gives its orientation, too")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    write(args.out, args.robot, args.place, args.fault, args.runs, args.seconds, args.orientation, args.seed)


if __name__ == "__main__":
    main()
