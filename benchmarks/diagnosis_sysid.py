"""The parameter fit that mujoco.sysid does, on the same cases: time, held-out error; then one candidate after another.

    pip install "mujoco[sysid]"
    python benchmarks/diagnosis_sysid.py CASE [CASE ...] --candidates

Mass, damping and armature within 20 %, windows of 0.5 s from the measured state (mujoco.sysid fits no initial states),
one operating condition held out. Candidates are those that MuJoCo has as an attribute: friction, spring, gain, bias.
"""

import argparse
import json
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid
from scipy.signal import savgol_filter

SPREAD, WINDOW, HELD_OUT = 0.2, 0.5, "chirp"
Windows = list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # initial state, controls and positions by row


def windows(folder: Path, model: mujoco.MjModel, held_out: bool) -> tuple[Windows, float]:
    """Windows of the runs in (or not in) the held-out condition, and the log period in s."""
    found: Windows = []
    for path in sorted((folder / "logs").glob("*.csv")):
        if (HELD_OUT in path.stem) != held_out:
            continue
        table = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
        u, q = (np.stack([table[n] for n in table.dtype.names if n.startswith(k)], 1) for k in ("ctrl:", "qpos:"))
        period = float(np.median(np.diff(table["time"])))
        v = savgol_filter(q, 7, 3, deriv=1, delta=period, axis=0)
        smooth = savgol_filter(q, 7, 3, axis=0)
        rows = round(WINDOW / period)
        for a in range(0, len(q) - rows, rows):
            state = sysid.create_initial_state(model, smooth[a], v[a], act=np.zeros(model.na))
            found.append((state, u[a : a + rows], q[a : a + rows + 1]))
    return found, period


def sequences(spec: mujoco.MjSpec, cut: Windows, period: float) -> sysid.ModelSequences:
    model = spec.compile()
    steps = round(period / model.opt.timestep)
    controls, sensors = [], []
    for _, u, q in cut:
        fine = np.repeat(u, steps, axis=0)  # held, not interpolated
        times = np.arange(len(fine) + 1) * model.opt.timestep
        held = np.concatenate([fine, fine[-1:]])
        controls.append(sysid.TimeSeries.from_control_names(times, held, model))
        names = [model.sensor(i).name for i in range(model.nsensor)]
        sensors.append(sysid.TimeSeries.from_names(np.arange(len(q)) * period, q, model, names=names))
    labels = [f"w{i}" for i in range(len(cut))]
    return sysid.ModelSequences("robot", spec, labels, [s for s, _, _ in cut], controls, sensors)


def specification(folder: Path) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(folder / "model.xml"))
    for joint in spec.joints:
        spec.add_sensor(
            name=f"{joint.name}_pos", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint.name,
        )  # fmt: skip
    return spec


def _write(nominal: mujoco.MjModel, place: str, what: str, spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
    """Set an attribute of a spec; factors are of the nominal value, so nothing accumulates."""
    x = float(parameter.value[0])
    if what == "mass":
        for geom in spec.body(place).geoms:
            geom.mass = x * nominal.body(place).mass[0]
    elif what == "damping":
        spec.joint(place).damping[0] = x * np.ravel(nominal.joint(place).damping)[0]
    elif what == "armature":
        spec.joint(place).armature = x * nominal.joint(place).armature[0]
    elif what == "friction":
        spec.joint(place).frictionloss = x
    elif what == "spring":
        spec.joint(place).stiffness[0] = x
    elif what == "gain":
        spec.actuator(place).gainprm = nominal.actuator(place).gainprm * x
        spec.actuator(place).biasprm = nominal.actuator(place).biasprm * x
    else:
        spec.actuator(place).biastype = mujoco.mjtBias.mjBIAS_AFFINE
        spec.actuator(place).biasprm[0] = x


def base(nominal: mujoco.MjModel) -> sysid.ParameterDict:
    bodies = [nominal.body(i).name for i in range(nominal.nbody) if nominal.body_weldid[i] != 0]
    joints = [nominal.joint(i).name for i in range(nominal.njnt)]
    pairs = [(b, "mass") for b in bodies] + [(j, a) for a in ("damping", "armature") for j in joints]
    params = sysid.ParameterDict()
    for place, what in pairs:
        write = partial(_write, nominal, place, what)
        params.add(sysid.Parameter(f"{place}.{what}", 1.0, 1 - SPREAD, 1 + SPREAD, modifier=write))
    return params


def candidates(nominal: mujoco.MjModel) -> Iterator[sysid.Parameter]:
    """One parameter per candidate, its bounds from a torque of the size of the robot's own."""
    joints = [nominal.joint(i).name for i in range(nominal.njnt)]
    actuators = [nominal.actuator(i).name for i in range(nominal.nu)]
    force = float(9.81 * nominal.body_mass[2:].sum() * 0.3)
    for places, what, start, low, high in (
        (joints, "friction", 1e-3 * force, 0.0, force), (joints, "spring", 1e-3 * force, 0.0, force),
        (actuators, "gain", 1.0, 0.5, 1.5), (actuators, "bias", 0.0, -force, force),
    ):  # fmt: skip
        for place in places:
            write = partial(_write, nominal, place, what)
            yield sysid.Parameter(f"{place}.{what}", start, low, high, modifier=write)


def fit(
    train: sysid.ModelSequences, test: sysid.ModelSequences, params: sysid.ParameterDict
) -> tuple[float, float, np.ndarray]:
    """(seconds, held-out root mean square in rad or m over all joints, estimates)."""
    started = time.perf_counter()
    found, _ = sysid.optimize(params, sysid.build_residual_fn(models_sequences=[train]), verbose=False, max_iters=30)
    return time.perf_counter() - started, error(test, found), found.as_vector()


def error(test: sysid.ModelSequences, params: sysid.ParameterDict) -> float:
    residual_fn = sysid.build_residual_fn(models_sequences=[test])
    _, simulated, measured = residual_fn(params.as_vector(), params)
    gap = [s.data - m.data for s, m in zip(np.ravel(simulated), np.ravel(measured), strict=True)]
    return float(np.sqrt(np.mean(np.square(gap))))


def compare(folder: Path, race: bool) -> dict:
    nominal = specification(folder).compile()
    (cut, period), (kept, _) = windows(folder, nominal, False), windows(folder, nominal, True)
    train, test = sequences(specification(folder), cut, period), sequences(specification(folder), kept, period)
    params = base(nominal)
    before = error(test, params)
    seconds, after, x = fit(train, test, params)
    truth = json.loads((folder / "truth.json").read_text())["base"]
    names = params.keys()  # not itself iterable
    off = float(np.sqrt(np.mean((x - np.array([truth[n] for n in names])) ** 2)))
    out = {"case": folder.name, "nominal": before, "fitted": after, "seconds": round(seconds, 1), "parameters off": off}
    if race:
        results = {}
        for extra in candidates(nominal):
            more = base(nominal)
            more.add(extra)
            took, reached, _ = fit(train, test, more)
            results[extra.name] = {"held out": reached, "seconds": round(took, 1)}
        out["candidates"] = results
        out["race seconds"] = round(sum(r["seconds"] for r in results.values()), 1)
        out["best"] = min(results, key=lambda n: results[n]["held out"])
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="+")
    parser.add_argument("--candidates", action="store_true", help="also fit each candidate effect in turn")
    args = parser.parse_args()
    for folder in args.cases:
        print(json.dumps(compare(folder, args.candidates)), flush=True)


if __name__ == "__main__":
    main()
