"""How often the checks of logs are wrong: on logs of frozen cases (`counted_cases.py`), as they are and with a fault.

    python benchmarks/diagnosis/log_checks.py --cases FOLDER --out rows.json    # cases are written where they are not

60 cases of six robots: nothing, one or two effects or a cause that the library does not have, data sheets 2 to 30 %
off, a fifth of poor logs. A log as it is has no fault of the kinds that are counted, so a remark on it is a false one.
Each fault is put into a copy of one log of each case. A drive is tested by efforts of its own in two logs of each case:
those of its commands, with 1 % noise. No number of the checks was made from these cases.
"""

import argparse
import json
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from counted_cases import Plan, frozen, make

from bayessim_mjx.diagnosis.logcheck import drives, noise
from bayessim_mjx.diagnosis.logcheck.gate import check
from bayessim_mjx.diagnosis.logcheck.links import channels_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import read_logs
from bayessim_mjx.logs.log import Array, Log

Fault = Callable[[Log, np.random.Generator], Log]
KINDS = ("clipped", "time:", "never", "jumps", "(degrees", "(millimetres", "unrelated", "no model", "late")


def late(x: Array, rows: int) -> Array:
    """x `[T, ...]`, `rows` later; negative: earlier."""
    return x[np.clip(np.arange(len(x)) - rows, 0, len(x) - 1)]


def moved(seconds: float) -> Fault:
    """Motion `seconds` behind its commands."""
    return lambda log, rng: replace(log, ctrl=late(log.ctrl, -round(seconds / log.period)), streams={})


def clipped(log: Log, rng: np.random.Generator) -> Log:
    qpos = log.qpos.copy()
    qpos[:, 0] = np.minimum(qpos[:, 0], np.quantile(qpos[:, 0], 0.85))
    return replace(log, qpos=qpos)


FAULTS: dict[str, Fault] = {
    "opposite sign": lambda log, rng: replace(log, ctrl=-log.ctrl, streams={}),
    "commands in reverse": lambda log, rng: replace(log, ctrl=log.ctrl[::-1], streams={}),
    "motion 50 ms late": moved(0.05),
    "motion 300 ms late": moved(0.3),
    "motion 50 ms early": moved(-0.05),
    "clipped": clipped,
    "jitter": lambda log, rng: replace(log, time=log.time + 0.8 * log.period * rng.uniform(-0.5, 0.5, len(log))),
    "degrees": lambda log, rng: replace(log, qpos=np.degrees(log.qpos), qvel=np.degrees(log.qvel)),
}
DRIVES: dict[str, Callable[[Array], Array]] = {
    "sound": lambda f: f,
    "gain 0.9": lambda f: 0.9 * f,
    "gain 1.1": lambda f: 1.1 * f,
    "constant of 10 %": lambda f: f + 0.1 * np.sqrt(np.mean(f**2)),
    "three rows late": lambda f: late(f, 3),
    "saturates at 80 %": lambda f: np.clip(f, -0.8 * np.abs(f).max(), 0.8 * np.abs(f).max()),
}


def of_drives(log: Log, model: mujoco.MjModel, fault: str, rng: np.random.Generator) -> Log:
    """With the effort of each drive: that of its command, and the first one's with a fault."""
    force = drives.commanded(log, model)
    own = [DRIVES[fault if i == 0 else "sound"](f) for i, f in enumerate(force.T)]
    noisy = [f + 0.01 * np.sqrt(np.mean(f**2)) * rng.normal(size=len(f)) for f in own]
    return replace(log, streams={f"effort:{a}": f for a, f in zip(log.actuators, noisy, strict=True)})


def judged(plan: Plan, folder: Path) -> Iterator[dict[str, Any]]:
    """The rows of a case: one of the logs as they are, one a fault."""
    if not (folder / plan.name / "truth.json").exists():
        make(plan, folder / plan.name)
    model = mujoco.MjModel.from_xml_path(str(folder / plan.name / "model.xml"))
    logs = read_logs(folder / plan.name / "logs", model, partial=True)
    about = {"case": plan.name, "kind": plan.kind, "logs": plan.logs}
    period = float(np.median([log.period for log in logs]))
    rng = np.random.default_rng(plan.seed)
    chosen = logs[len(logs) // 3 : len(logs) // 3 + 1]
    for name in ("none", *FAULTS):
        some = logs if name == "none" else [FAULTS[name](log, rng) for log in chosen]
        gate = check(some, model, max(period, 0.002))
        related = [r for report in gate.reports for r in report.relations if r.explained is not None]
        yield about | {
            "fault": name, "count": len(some), "refused": gate.refused, "period": period,
            "explained": [r.explained for r in related],
            "lag": [(r.late.seconds, r.late.error, r.lag) for r in related],
            "remarks": [f.text for report in gate.reports for f in report.remarks],
            "velocities": [(v.slope, v.lag, v.correlation) for report in gate.reports for v in report.velocities],
            "noise free": [noise.noise_free(some, c) for c in range(model.nq)],
        }  # fmt: skip
    smooth = [replace(log, qpos=_smooth(log)) for log in chosen]
    yield about | {"fault": "no noise", "noise free": [noise.noise_free(smooth, c) for c in range(model.nq)]}
    for name in DRIVES if model.nu else ():
        found = channels_of([of_drives(log, model, name, rng) for log in logs[:2]], model, True)
        keys = ("scale", "deviation", "late", "left", "peak", "off", "shifted", "static", "sound", "identified", "echo")
        yield about | {"drive": name, "channels": [{k: getattr(c, k) for k in keys} for c in found]}


def reading(plan: Plan, folder: Path) -> Iterator[dict[str, Any]]:
    """One row for each way in which a file is written otherwise: into how many logs it is read, and what is said."""
    model = mujoco.MjModel.from_xml_path(str(folder / plan.name / "model.xml"))
    files = sorted((folder / plan.name / "logs").glob("*.csv"))
    file, rng = files[len(files) // 3], np.random.default_rng(plan.seed)
    header = file.read_text().splitlines()[0]
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    for name, change in FILES.items():
        with tempfile.TemporaryDirectory() as place, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            copy = Path(place) / file.name
            np.savetxt(copy, change(rows, header.split(","), rng), "%.9g", ",", header=header, comments="")
            copy.with_suffix(".yaml").write_text(file.with_suffix(".yaml").read_text())
            try:
                pieces, refused = len(read_logs(copy, model, partial=True)), ""
            except UserError as error:
                pieces, refused = 0, str(error)
        texts = [str(w.message) for w in said]
        yield {"case": plan.name, "file": name, "pieces": pieces, "refused": refused, "said": texts}


def _in_degrees(rows: Array, header: Sequence[str], rng: np.random.Generator) -> Array:
    turned = [name.startswith("qpos:") and name != "qpos:slider" for name in header]
    return np.where(turned, np.degrees(rows), rows)


def _jittered(rows: Array, header: Sequence[str], rng: np.random.Generator) -> Array:
    out = rows.copy()
    out[:, 0] += 0.8 * np.median(np.diff(rows[:, 0])) * rng.uniform(-0.5, 0.5, len(rows))
    return out


def _first(rows: Array, header: Sequence[str]) -> int:
    """Return the column of the first position that moves by more than 0.05."""
    return next(i for i, n in enumerate(header) if n.startswith("qpos:") and np.ptp(rows[:, i]) > 0.05)


def _anew(rows: Array, header: Sequence[str], rng: np.random.Generator) -> Array:
    """From the row of its largest size on, in the middle half of the file, a position counts from 0."""
    out, i, quarter = rows.copy(), _first(rows, header), len(rows) // 4
    row = quarter + int(np.argmax(np.abs(rows[quarter : 3 * quarter, i])))
    out[row:, i] -= rows[row, i]
    return out


def _off(share: float) -> Callable[[Array, Sequence[str], np.random.Generator], Array]:
    """Return what moves one sample of a position by a share of its range."""

    def moved(rows: Array, header: Sequence[str], rng: np.random.Generator) -> Array:
        out, i = rows.copy(), _first(rows, header)
        out[len(rows) // 2, i] += share * np.ptp(rows[:, i])
        return out

    return moved


def _still(rows: Array, header: Sequence[str], rng: np.random.Generator) -> Array:
    """Hold a position for 0.3 s from where it is fastest, in the second quarter of the file."""
    out, i, quarter = rows.copy(), _first(rows, header), len(rows) // 4
    row = quarter + int(np.argmax(np.abs(np.diff(rows[:, i]))[quarter : 2 * quarter]))
    out[row : row + max(5, int(0.3 / np.median(np.diff(rows[:, 0])))), i] = rows[row, i]
    return out


FILES: dict[str, Callable[[Array, Sequence[str], np.random.Generator], Array]] = {
    "as it is": lambda rows, header, rng: rows,
    "a gap of 4 periods": lambda rows, header, rng: np.delete(rows, range(40, 43), axis=0),
    "a gap of 8 periods": lambda rows, header, rng: np.delete(rows, range(40, 47), axis=0),
    "each seventh row again": lambda rows, header, rng: np.repeat(rows, 1 + (np.arange(len(rows)) % 7 == 0), axis=0),
    "positions in degrees": _in_degrees,
    "stamps that jitter": _jittered,
    "a position that begins anew": _anew,
    "a sample off by 20 %": _off(0.2),
    "a sample off by 5 %": _off(0.05),
    "0.3 s of one value": _still,
}


def _smooth(log: Log) -> Array:
    """Positions `[T, nq]` without noise: sums of slow sines of about the same size."""
    t = log.time[:, None] - log.time[0]
    return np.std(log.qpos, 0) * (np.sin(3 * t) + 0.3 * np.sin(11 * t + np.arange(log.qpos.shape[1])))


def share(hits: Sequence[bool]) -> str:
    """Counts, and the Wilson interval (95 %) of their share."""
    n, k = len(hits), int(np.sum(hits))
    if not n:
        return "0/0"
    z, p = 1.96, k / n
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = ((middle + s * half) / (1 + z * z / n) for s in (-1, 1))
    return f"{k}/{n} ({100 * low:.1f} to {100 * high:.1f} %)"


def table(rows: Sequence[dict[str, Any]]) -> None:
    """Refusals, remarks, the share of efforts explained and latenesses by fault; drives by fault."""
    for name in ("none", *FAULTS):
        own = [r for r in rows if r.get("fault") == name]
        torque = [r for r in own if r["explained"]]
        print(f"\n{name}: refused {share([i < len(r['refused']) for r in torque for i in range(r['count'])])}")
        texts = [text for r in own for text in r["remarks"]]
        print(f"  of {sum(r['count'] for r in own)} logs:", {k: sum(k in t for t in texts) for k in KINDS})
        explained = np.array([e for r in torque for e in r["explained"]])
        print(
            "  explained, quantiles .01 .05 .5 .95 .99:", np.quantile(explained, [0.01, 0.05, 0.5, 0.95, 0.99]).round(3)
        )
        print(*(f"  below {level}: {share(list(explained < level))}" for level in (0.3, 0.5, 0.7)))
        print(f"  lag named: {share([named != 0 for r in torque for _, _, named in r['lag']])}")
        seen = [1e3 * (named - 0.5 * r["period"]) for r in torque for _, _, named in r["lag"] if named]
        print("  named lag less half a row, ms:", np.quantile(seen, [0.05, 0.5, 0.95]).round(1) if seen else "")
        usable = [
            abs(a - 1) < 0.1 and abs(t) <= 0.6 * r["period"] and c > 0.95 for r in own for a, t, c in r["velocities"]
        ]
        print("  velocities usable:", share(usable))
    _late(rows)
    for name in ("none", "no noise"):
        print(f"noise free, {name}:", share([x for r in rows if r.get("fault") == name for x in r["noise free"]]))
    for name in DRIVES:
        _drives(name, [c["channels"][0] for c in rows if c.get("drive") == name and c["channels"]])
    for name in FILES:
        own = [r for r in rows if r.get("file") == name]
        print(f"\nfile, {name}: refused {share([bool(r['refused']) for r in own])}", end="; ")
        print(f"in one piece {share([r['pieces'] == 1 for r in own])}", end=", ")
        print(
            f"warned of {share([bool(r['said']) for r in own])}, "
            f"jumps named {share([any('it jumps' in text for text in r['said']) for r in own])}"
        )


def _late(rows: Sequence[dict[str, Any]]) -> None:
    """Known latenesses against their estimates, in standard errors: what a fault moves within one log."""
    before = {(r["case"], i): x for r in rows if r.get("fault") == "motion 50 ms late" for i, x in enumerate(r["lag"])}
    after = {(r["case"], i): x for r in rows if r.get("fault") == "motion 50 ms early" for i, x in enumerate(r["lag"])}
    own = [(before[k], after[k]) for k in before if k in after]
    away = [(b[0] - a[0] - 0.1) / np.hypot(b[1], a[1]) for b, a in own if b[2] and a[2] and b[1] > 0 < a[1]]
    print(
        f"\n100 ms between two commands, error in standard errors ({len(away)}):", np.quantile(away, [0.05, 0.5, 0.95])
    )


def _drives(name: str, first: Sequence[dict[str, Any]]) -> None:
    print(f"\ndrive {name}: identified {share([c['identified'] for c in first])}", end="; ")
    first = [c for c in first if c["identified"]]
    for key, test in (("sound", bool), ("off", lambda x: x != 1.0), ("shifted", bool), ("static", bool)):
        print(f"{key} {share([test(c[key]) for c in first])}", end="; ")
    for key in ("scale", "left", "peak"):
        print(key, np.quantile([c[key] for c in first], [0.01, 0.05, 0.5, 0.95, 0.99]).round(4), end="; ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True, help="folder of the cases")
    parser.add_argument("--only", nargs="+", default=(), metavar="NAME", help="cases; default: all that are frozen")
    parser.add_argument("--out", type=Path, help="file for every row; rows that it has are not made again")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(args.out.read_text()) if args.out and args.out.exists() else []
    made = {r["case"] for r in rows}
    for plan in frozen():
        if plan.name in made or (args.only and plan.name not in args.only):
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows += [*judged(plan, args.cases), *reading(plan, args.cases)]
        if args.out:
            args.out.write_text(json.dumps(rows, default=float))
    table(rows)


if __name__ == "__main__":
    main()
