"""Cases of the blind suite: what is hidden in each kind, drawn by seed, written and sealed."""

import dataclasses
import shutil
import sys
import zlib
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "diagnosis"))

from drawn import DRAWN

from bayessim_mjx import atomic
from bayessim_mjx.blind import seal
from bayessim_mjx.blind.cases import data_sheet, hidden, write_logs
from bayessim_mjx.blind.check import WIDEST
from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.menu import UNKNOWN, draw_cause, places
from bayessim_mjx.blind.reality.plant import Plant, Run, scales_of
from bayessim_mjx.blind.reality.strength import HIDDEN, Ruler, resize
from bayessim_mjx.blind.reality.system import System

VERSION = 1  # of the suite: another one has other cases
ACCURACY = 0.05  # of data-sheet values
# kind: (effects, unknown ones, encoder noises)
KINDS = {
    "single": (1, False, 20.0),
    "weak": (1, False, 4.0),
    "double": (2, False, 20.0),
    "unknown": (1, True, 20.0),
    "null": (0, False, 0.0),
    "coloured": (0, False, 0.0),
}
COLOUR, LOUD, JITTER = 0.1, 1.5, 0.1  # s; of the white noise; of the period


def make(robot: System, kind: str, seed: int, out: Path) -> bool:
    """Write a case that is not there yet; whether it was written."""
    name = f"{robot.name}_{kind}_{seed}"
    case = out / "cases" / name
    if (case / "seal.txt").exists():
        return False
    shutil.rmtree(case, ignore_errors=True)
    rng = np.random.default_rng((VERSION, seed, zlib.crc32(f"{robot.name} {kind}".encode())))
    base = data_sheet(robot, ACCURACY, rng)
    count, unknown, strength = KINDS[kind]
    causes, effects = _causes(robot, base, count, unknown, strength, seed, rng)
    plant = Plant(robot, base, causes)
    runs = [robot.record(plant, i, seed) for i in range(len(robot.labels))]
    if kind == "coloured":
        runs = [coloured(robot, r, rng) for r in runs]
    given = case / "given"
    write_logs(given / "logs", robot, runs, bool(rng.uniform() < 0.5), False, rng)
    (given / "model.xml").write_text(robot.xml)
    truth = {"version": VERSION, "robot": robot.name, "kind": kind, "seed": seed, "base": base, "effects": effects}
    code = seal.close(truth | {"salt": seal.digest(rng.bytes(32))}, given, out / "sealed" / f"{name}.json")
    atomic.write_text(case / "seal.txt", code)
    return True


def _causes(
    robot: System, base: dict, count: int, unknown: bool, strength: float, seed: int, rng: np.random.Generator
) -> tuple[list[Cause], list[dict]]:
    """(causes of the strength, what a truth tells of them): effects take turns with the seeds."""
    if not count:
        return [], []
    ruler = Ruler(robot, base, WIDEST * ACCURACY, seed)
    scales = scales_of(ruler.plain, ruler.runs)
    able = [e for e in (UNKNOWN if unknown else DRAWN) if places(robot, e, scales)]
    turn = list(np.random.default_rng(zlib.crc32(robot.name.encode())).permutation(able))
    names = [turn[(seed + k * (1 + seed % (len(turn) - 1))) % len(turn)] for k in range(count)]
    causes: list[Cause] = []
    told = []
    for name in names:
        cause = draw_cause(str(name), robot, scales, causes, rng)
        raw, left = resize(cause, ruler, strength)
        causes.append(cause)
        told.append(hidden(cause) | {"raw": raw, "left": left, "strength": min(raw, HIDDEN * left)})
    return causes, told


def coloured(robot: System, r: Run, rng: np.random.Generator) -> Run:
    """A run with noise that lasts and time stamps that jitter, as loggers of real robots have them."""
    keep = np.exp(-robot.period / COLOUR)
    noise = np.zeros_like(r.qpos)
    noise[0] = rng.normal(size=noise.shape[1])
    for k in range(1, len(noise)):
        noise[k] = keep * noise[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=noise.shape[1])
    time = r.time + JITTER * robot.period * rng.uniform(-1, 1, len(r.time))
    return dataclasses.replace(r, qpos=r.qpos + LOUD * np.asarray(robot.sigma) * noise, time=time - time[0])
