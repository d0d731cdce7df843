"""Files of logs as people write them: is each read rightly, or refused with the key that mends it?

    python benchmarks/tests/log_dialects.py [--second] [--only WORD ...] [--out rows.json] [--verbose]

The faults stand in log_dialects_texts.py, log_dialects_names.py and log_dialects_imports.py: small files whose truth is
known, each of a kind that people complain about in public. None of them is among the tests of the library, and the
list was written before any of them was tried. Of each `bayessim-mjx logs check` is run, then the logs are read as
`diagnose` reads them, with the map that the check wrote. Exit code 0 if nothing is misread in silence and nothing ends
in a traceback.
"""

import argparse
import contextlib
import io
import json
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

ARM = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.005"/><worldbody>
<body><joint name="shoulder" axis="0 1 0"/><geom size=".02" mass="1" pos="0 0 -.2"/>
<body pos="0 0 -.3"><joint name="elbow" axis="0 1 0" range="-2.5 2.5"/><geom size=".02" mass=".5" pos="0 0 -.2"/></body>
</body></worldbody><actuator><motor name="m_shoulder" joint="shoulder" ctrlrange="-8 8"/>
<motor name="m_elbow" joint="elbow" ctrlrange="-8 8"/></actuator></mujoco>"""
SERVO = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.005"/><worldbody>
<body><joint name="pan" axis="0 0 1"/><geom size=".02" mass="1" pos=".1 0 -.2"/>
<body pos="0 0 -.3"><joint name="tilt" axis="0 1 0" range="-1.6 1.6"/><geom size=".02" mass=".5" pos="0 0 -.2"/></body>
</body></worldbody><actuator><position name="pan" joint="pan" kp="9"/>
<position name="tilt" joint="tilt" kp="9"/></actuator></mujoco>"""
FLOAT = """<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.005"/><worldbody>
<geom type="plane" size="1 1 1"/><body name="trunk" pos="0 0 .5"><freejoint name="root"/><geom size=".1" mass="2"/>
<site name="imu"/><body pos="0 0 -.1"><joint name="knee" axis="0 1 0" range="-2.5 2.5"/>
<geom size=".03" mass=".5" pos="0 0 -.2"/></body></body></worldbody>
<actuator><motor name="m_knee" joint="knee"/></actuator>
<sensor><gyro name="imu_gyro" site="imu"/><accelerometer name="imu_accel" site="imu"/></sensor></mujoco>"""
MODELS = {"arm": ARM, "servo": SERVO, "float": FLOAT}
HEADERS = {
    "arm": ("time", "ctrl:m_shoulder", "ctrl:m_elbow", "qpos:shoulder", "qpos:elbow"),
    "servo": ("time", "ctrl:pan", "ctrl:tilt", "qpos:pan", "qpos:tilt"),
}


def arm(rows: int = 200) -> np.ndarray:
    """Return a log of the arm [rows, 5]: time, torques, angles."""
    t = 0.01 * np.arange(rows)
    angles = 0.9 * np.sin(2.3 * t + 0.4), 0.6 * np.cos(3.1 * t) - 0.2
    return np.stack([t, 1.7 * np.sin(4.1 * t) + 0.3, 0.9 * np.cos(5.3 * t), *angles], 1)


def servo(rows: int = 200) -> np.ndarray:
    """Return a log of the servos [rows, 5]: time, targets, angles 30 ms behind them."""
    t = 0.01 * np.arange(rows)
    pan, tilt = (lambda t: 0.9 * np.sin(2.3 * t)), (lambda t: 0.7 * np.cos(3.1 * t) - 0.1)
    return np.stack([t, pan(t), tilt(t), pan(t - 0.03), tilt(t - 0.03)], 1)


A, S = arm(), servo()
TRUTHS = {"arm": A, "servo": S}


@dataclass(frozen=True)
class Fault:
    """One fault of a dialect.

    Attributes:
        name: of it. complaint: where people complain of its kind.
        files: {name: bytes} of the folder, or what writes them into it.
        words: any of them in what is said names the way on.
        mend: keys of the map that read it rightly, or what changes the folder; None: no way is known.
        model: of MODELS. truth: [T, 1 + nu + nq]. within: of the numbers. log_map: the user's own.
        convert: words of `logs COMMAND`, before the paths, by which the files are converted first.
        paths: the files that are converted. again: the words that mend a refusal of the converter.
        pieces: whether it is right to cut the file into several logs.
        streams: {stream: [T]} that has to be read, too. absent: channels that are right to be missing.
    """

    name: str
    complaint: str
    files: Mapping[str, bytes] | Callable[[Path], None]
    words: Sequence[str] = ()
    mend: Any = None
    model: str = "arm"
    truth: Any = None
    within: float = 2e-6
    log_map: Mapping[str, Any] | None = None
    convert: Sequence[str] = ()
    paths: Sequence[str] = ()
    again: Sequence[str] = ()
    pieces: bool = False
    streams: Mapping[str, Any] | None = None
    absent: Sequence[str] = ()


Cells = Callable[[int, int, float], str]


def text(table: np.ndarray, header: str, sep: str = ",", form: str | Cells = "%.7g", end: str = "\n") -> str:
    """Write a table as text; `form` is a format, or what makes a field of (row, column, value)."""
    make: Cells = form if callable(form) else lambda i, j, x: form % x
    lines = [sep.join(make(i, j, x) for j, x in enumerate(row)) for i, row in enumerate(table)]
    return end.join([*([header] if header else []), *lines]) + end


def plain(table: np.ndarray, model: str = "arm", more: Sequence[str] = (), form: str | Cells = "%.9g") -> str:
    """Write a table under the library's own names."""
    return text(table, ",".join((*HEADERS[model], *more)), form=form)


def put(table: np.ndarray, column: int, values: Any) -> np.ndarray:
    """Return the table with another column."""
    out = table.copy()
    out[:, column] = values
    return out


def csv(content: str, encoding: str = "utf-8") -> dict[str, bytes]:
    """Return a folder of one file."""
    return {"run.csv": content.encode(encoding)}


def _called(words: Sequence[str]) -> tuple[int, str]:
    from bayessim_mjx import import_logs

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            code = import_logs.main(list(words))
        except SystemExit as stop:
            code = int(stop.code or 0)
    return code, said.getvalue()


def _read(folder: Path, fault: Fault, mend: Mapping[str, Any] | None = None) -> tuple[list[Any], str]:
    """(logs, what was said): as `diagnose` reads the folder, with its map and the keys of a mend."""
    from bayessim_mjx.logs import read_logs

    own = folder / "map.yaml"
    content = yaml.safe_load(own.read_text()) if own.is_file() else None
    if mend is not None:
        content = {**(content or {}), **mend}
        content = {key: value for key, value in content.items() if value is not None}
    model = mujoco.MjModel.from_xml_string(MODELS[fault.model])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        logs = read_logs(folder, model, content, partial=True)
    return logs, "\n".join(str(w.message) for w in said)


def _right(logs: Sequence[Any], fault: Fault) -> str:
    """Return what differs from the truth, or ""."""
    truth = TRUTHS[fault.model] if fault.truth is None else fault.truth
    if len(logs) > 1 and not fault.pieces:
        return f"{len(logs)} pieces"
    absent = [name for log in logs for name in log.absent]
    if absent != list(fault.absent):
        return f"without {', '.join(absent)}"
    time = np.concatenate([log.time - log.time[0] for log in logs])
    table = np.concatenate([np.c_[log.ctrl, log.qpos] for log in logs])
    if len(time) != len(truth):
        return f"{len(time)} rows of {len(truth)}"
    steps = np.diff(time), np.diff(truth[:, 0])
    joined = np.zeros(len(steps[0]), bool)
    joined[[len(log.time) - 1 for log in logs[:-1]]] = True
    off = np.abs(steps[0] - steps[1])[~joined].max()
    if off > max(fault.within, 3e-6):
        return f"steps of time off by {off:.3g} s"
    for j, column in enumerate(table.T):
        off = np.abs(column - truth[:, 1 + j]).max()
        if off > fault.within and logs[0].channels.qpos[j - logs[0].ctrl.shape[1]] in [n[5:] for n in absent]:
            continue
        if off > fault.within:
            return f"column {j} off by {off:.3g}"
    for name, values in (fault.streams or {}).items():
        found = logs[0].streams.get(name)
        if found is None or np.nanmax(np.abs(found - values)) > fault.within:
            return f"stream {name}"
    return ""


def _fill(folder: Path, files: Any) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if callable(files):
        files(folder)
    else:
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)


def tried(fault: Fault, root: Path) -> tuple[str, str]:
    """(right, key, no key, warned, silent or traceback; what was said) of one fault."""
    from bayessim_mjx.errors import UserError

    folder, said = root / "logs", ""
    _fill(folder, fault.files)
    model = root / "robot.xml"
    model.write_text(MODELS[fault.model])
    if fault.convert:
        words = [*fault.convert, *(str(folder / p) for p in fault.paths)]
        ends = ["--out", str(root / "out"), "--model", str(model)]
        code, said = _called([*words[:1], *words[len(fault.convert) :], *words[1 : len(fault.convert)], *ends])
        if code == 2:
            if not any(word in said for word in fault.words):
                return "no key", said
            if not fault.again:
                return ("key" if fault.mend == "nothing" else "no key"), said
            code, more = _called([*words[:1], *words[len(fault.convert) :], *fault.again, *ends])
            if code:
                return "no key", said + more
            wrong = _right(_read(root / "out", fault)[0], fault)
            return ("no key", said + wrong) if wrong else ("key", said)
        folder = root / "out"
    elif fault.log_map is not None:
        (folder / "map.yaml").write_text(yaml.safe_dump(dict(fault.log_map)))
    _, checked = _called(["check", str(folder), "--model", str(model)])
    said += "\n".join(line for line in checked.splitlines() if line.startswith(("note:", "missing:")))
    try:
        logs, warned = _read(folder, fault)
        said += warned
        wrong = _right(logs, fault)
    except UserError as error:
        said += str(error)
        return _mended(folder, fault, said)
    if not wrong:
        return "right", said
    named = any(word in said for word in fault.words)
    return ("warned" if named else "silent"), f"{wrong}\n{said}"


def _mended(folder: Path, fault: Fault, said: str) -> tuple[str, str]:
    """Whether the way on stands in a refusal, and is one."""
    from bayessim_mjx.errors import UserError

    if not any(word in said for word in fault.words):
        return "no key", said
    if fault.mend == "nothing":  # nobody can know more: naming what is wrong is all
        return "key", said
    if fault.mend is None:
        return "no key", said
    if callable(fault.mend):
        for path in list(folder.iterdir()):
            if path.name != "map.yaml":
                path.unlink()
        _fill(folder, fault.mend)
    try:
        logs, more = _read(folder, fault, None if callable(fault.mend) else fault.mend)
    except UserError as error:
        return "no key", f"{said}\nMENDED: {error}"
    wrong = _right(logs, fault)
    return ("no key", f"{said}\nMENDED: {wrong}\n{more}") if wrong else ("key", said)


def every(second: bool = False) -> list[Fault]:
    """All faults of the first list, or of the second."""
    import log_dialects_imports
    import log_dialects_names
    import log_dialects_second
    import log_dialects_texts

    if second:
        return log_dialects_second.FAULTS
    return [*log_dialects_texts.FAULTS, *log_dialects_names.FAULTS, *log_dialects_imports.FAULTS]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--second", action="store_true", help="the list that was written after the first was mended")
    parser.add_argument("--only", nargs="+", default=[], help="words of the names")
    parser.add_argument("--out", type=Path, help="JSON file of all outcomes")
    parser.add_argument("--verbose", action="store_true", help="what was said of each that is not read rightly")
    args = parser.parse_args(argv)
    rows = []
    for fault in every(args.second):
        if args.only and not any(word in fault.name for word in args.only):
            continue
        with tempfile.TemporaryDirectory() as folder:
            try:
                outcome, said = tried(fault, Path(folder))
            except ModuleNotFoundError as error:
                outcome, said = "not tried", str(error)
            except Exception:  # noqa: BLE001  # the benchmark counts them
                outcome, said = "traceback", traceback.format_exc()
            rows.append({"name": fault.name, "outcome": outcome, "said": said.replace(folder, "")})
        shown = "right" if outcome in ("right", "key") else outcome.upper()
        print(f"{outcome:10} {fault.name}" + (f"\n    {said[:1500]}" if args.verbose and shown != "right" else ""))
    counts = Counter(row["outcome"] for row in rows)
    print(", ".join(f"{key} {n}" for key, n in counts.items()), f"of {len(rows)}")
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1))
    return int(counts["silent"] + counts["traceback"] > 0)


if __name__ == "__main__":
    sys.exit(main())
