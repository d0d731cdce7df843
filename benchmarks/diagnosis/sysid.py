"""Against mujoco.sysid, in one process on the same core: the same parameter fit, then all candidates one after another.

    pip install "mujoco[sysid]"
    taskset -c 0 python benchmarks/diagnosis/sysid.py CASE [CASE ...] [--race [--one-place]]

Known parameters: mass, damping and armature within 20 %; one operating condition is held out. mujoco.sysid with its own
defaults gets whole runs, as in its documentation, and also the windows that the library fits; it fits no start states,
which come from smoothed encoders. Joint positions are compared as states: its joint sensors lag by one timestep.
Candidates for mujoco.sysid are those that MuJoCo has as an attribute, with the library's bounds. Times are CPU seconds.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fitter
import mujoco
import native
import numpy as np
from mujoco import sysid
from scipy.signal import savgol_filter

WINDOW, HELD_OUT = 0.5, "chirp"
Pieces = list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # initial state, controls and positions by row


def pieces(folder: Path, model: mujoco.MjModel, held_out: bool | None, seconds: float | None) -> tuple[Pieces, float]:
    """Runs in (or not in, or None: all) the held-out condition, whole or cut, and the log period in s."""
    found: Pieces = []
    for path in sorted((folder / "logs").glob("*.csv")):
        if held_out is not None and (HELD_OUT in path.stem) != held_out:
            continue
        table = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
        names = table.dtype.names or ()
        u, q = (np.stack([table[n] for n in names if n.startswith(k)], 1) for k in ("ctrl:", "qpos:"))
        period = float(np.median(np.diff(table["time"])))
        v = savgol_filter(q, 7, 3, deriv=1, delta=period, axis=0)
        smooth = savgol_filter(q, 7, 3, axis=0)
        rows = round(seconds / period) if seconds else len(q) - 1
        for a in range(0, len(q) - rows, rows):
            state = sysid.create_initial_state(model, smooth[a], v[a], act=np.zeros(model.na))
            found.append((state, u[a : a + rows], q[a : a + rows + 1]))
    return found, period


def sequences(spec: mujoco.MjSpec, cut: Pieces, period: float) -> sysid.ModelSequences:
    """Controls held over every timestep, positions compared as states at the end of every period."""
    model = spec.compile()
    steps = round(period / model.opt.timestep)
    joints = [(model.joint(i).name, sysid.SignalType.MjStateQPos) for i in range(model.njnt)]
    controls, measured = [], []
    for _, u, q in cut:
        fine = np.repeat(u, steps, axis=0)
        times = np.arange(len(fine) + 1) * model.opt.timestep
        controls.append(sysid.TimeSeries.from_control_names(times, np.concatenate([fine, fine[-1:]]), model))
        measured.append(sysid.TimeSeries.from_names(np.arange(len(q)) * period, q, model, names=joints))
    labels = [f"piece {i}" for i in range(len(cut))]
    return sysid.ModelSequences("robot", spec, labels, [s for s, _, _ in cut], controls, measured)


def optimise(
    data: sysid.ModelSequences, params: sysid.ParameterDict, threads: int | None = 1
) -> tuple[float, sysid.ParameterDict]:
    """(CPU s, estimates) with the defaults of mujoco.sysid; threads: None for its default, one per core."""
    more = {} if threads is None else {"n_threads": threads}
    residual_fn = sysid.build_residual_fn(models_sequences=[data], **more)
    with contextlib.redirect_stdout(io.StringIO()):  # its optimiser reports every iteration
        seconds, (found, _) = fitter.timed(lambda: sysid.optimize(params, residual_fn, verbose=False))
    return seconds, found


def error(data: sysid.ModelSequences, params: sysid.ParameterDict) -> float:
    """Root mean square in rad or m over all joints."""
    residual_fn = sysid.build_residual_fn(models_sequences=[data])
    _, simulated, measured = residual_fn(params.as_vector(), params)
    gap = [s.data - m.data for s, m in zip(np.ravel(simulated), np.ravel(measured), strict=True)]
    return float(np.sqrt(np.mean(np.square(gap))))


VARIANTS = {  # of mujoco.sysid: length of the pieces in s (None: whole runs), threads
    "runs": (None, 1),
    "windows": (WINDOW, 1),
    "threads": (None, None),
}


def compare_fit(folder: Path, variants: Sequence[str]) -> dict:
    """The parameter fit: seconds, held-out windows in MuJoCo C, error of the factors (root mean square)."""
    xml = str(folder / "model.xml")
    nominal = native.specification(xml).compile()
    truth = json.loads((folder / "truth.json").read_text())["base"]
    test = sequences(native.specification(xml), *pieces(folder, nominal, True, WINDOW))
    out: dict[str, Any] = {}

    def note(name: str, seconds: float, x: dict[str, float]) -> None:
        params = native.base(nominal)
        names = params.keys()  # not itself iterable
        params.update_from_vector(np.array([x[n] for n in names]))
        off = float(np.sqrt(np.mean([(x[n] - truth[n]) ** 2 for n in truth])))
        out[name] = {"seconds": seconds, "off": off, "held out": error(test, params)}

    note("nominal", 0.0, dict.fromkeys(truth, 1.0))
    note("truth", 0.0, truth)
    for name in variants:
        length, threads = VARIANTS[name]
        train = sequences(native.specification(xml), *pieces(folder, nominal, False, length))
        params = native.base(nominal)
        seconds, found = optimise(train, params, threads)
        note(f"sysid, {name}", seconds, dict(zip(params.keys(), found.as_vector().tolist(), strict=True)))
    ours = fitter.fit(folder, HELD_OUT)
    note("library", ours["fit"], ours["x"])
    out["library"] |= {k: ours[k] for k in ("prepare", "compile")}
    return out


def compare_race(folder: Path, variant: str, one_place: bool) -> dict:
    """All candidates by the library; by mujoco.sysid those that MuJoCo has, from off the bounds."""
    ours, candidates = fitter.fit_all(folder)
    print(json.dumps(ours), file=sys.stderr, flush=True)
    if one_place:
        candidates = list({c.effect: c for c in reversed(candidates) if c.where != "all"}.values())
    nominal = native.specification(str(folder / "model.xml"), loads=True).compile()
    length, threads = VARIANTS[variant]
    data = pieces(folder, nominal, None, length)
    each, fits = {}, {}
    for extra in native.effects(nominal, candidates):
        payload = extra.name.startswith("payload")
        train = sequences(native.specification(str(folder / "model.xml"), loads=payload), *data)
        params = native.base(nominal)
        params.add(extra)
        params.move_off_bounds()
        each[extra.name], found = optimise(train, params, threads)
        fits[extra.name] = error(train, found)
        print(f"{extra.name}: {each[extra.name]:.1f} s", file=sys.stderr, flush=True)
    return {"library": ours, "sysid": each, "sysid best": min(fits, key=lambda n: fits[n])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="+")
    parser.add_argument("--race", action="store_true", help="all candidates instead of the parameter fit")
    parser.add_argument("--variants", default="runs,windows,threads", help="of mujoco.sysid; --race takes the first")
    parser.add_argument("--one-place", action="store_true", help="mujoco.sysid fits every effect at one place only")
    args = parser.parse_args()
    if not hasattr(sysid, "optimize"):
        sys.exit('mujoco.sysid lacks its dependencies: pip install "mujoco[sysid]"')
    variants = args.variants.split(",")
    for folder in args.cases:
        told = compare_race(folder, variants[0], args.one_place) if args.race else compare_fit(folder, variants)
        print(json.dumps({"case": folder.name} | told, default=float), flush=True)


if __name__ == "__main__":
    main()
