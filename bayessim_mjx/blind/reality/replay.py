"""A user's robot under the commands, rates and noise of its own logs."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.plant import Plant, Run

# choices, by no measurement
STRAY = 0.25  # of a joint's range of motion in the logs: a robot that leaves its log by more is led back
LEAD = 2 * np.pi * 1.5  # rad/s, of the weak controller that leads it back, with a damping ratio of 0.7
SHORT = 6.0  # s, of the runs that measure strength
PUSHED = 4  # of them


@dataclasses.dataclass(frozen=True, eq=False)
class Take:
    """One log as an experiment that can be repeated.

    Attributes:
        name: of the file, without its ending; metadata: its side YAML, `condition` among it.
        time: [T] s; ctrl: [T, nu]; qpos, qvel: [T, n] as logged, where the motion begins and is led to.
        led: whether a weak controller around the joints' drives adds to the commands.
        late: s by which commands act later than their rows say, at least 0; linear: they run straight from row to row.
    """

    name: str
    metadata: Mapping[str, Any]
    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    led: bool = False
    late: float = 0.0
    linear: bool = False

    def shortened(self, seconds: float) -> "Take":
        rows = int(np.searchsorted(self.time - self.time[0], seconds))
        cut = {k: getattr(self, k)[:rows] for k in ("time", "ctrl", "qpos", "qvel")}
        return dataclasses.replace(self, **cut)


@dataclasses.dataclass(frozen=True, eq=False)
class Replay:
    """A rig (see `plant.Rig`) whose runs are those of logs.

    Attributes:
        load: gives the nominal model anew, every element with a name.
        sigma, speed_sigma: of measured positions and velocities; quantum: steps of the encoders, 0 where none show.
    """

    name: str
    load: Callable[[], mujoco.MjSpec]
    period: float
    takes: tuple[Take, ...]
    sigma: Sequence[float]
    speed_sigma: Sequence[float]
    quantum: Sequence[float]
    base: str = ""
    tilts: bool = True
    touching: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(str(t.metadata.get("condition", t.name)) for t in self.takes)

    @property
    def pushed(self) -> tuple[int, ...]:
        """Runs of different conditions first."""
        first = [self.labels.index(label) for label in dict.fromkeys(self.labels)]
        rest = [i for i in range(len(self.takes)) if i not in first]
        return tuple(sorted([*first, *rest][:PUSHED]))

    def spec(self) -> mujoco.MjSpec:
        return self.load()

    def shortened(self, seconds: float = SHORT) -> "Replay":
        """Keep the first seconds of every run of the same robot."""
        return dataclasses.replace(self, takes=tuple(t.shortened(seconds) for t in self.takes))

    def record(self, plant: Plant, index: int, seed: int, noise: bool = True) -> Run:
        """Repeat the log's commands; where the plant would leave the log, a weak controller adds to them."""
        take, rng = self.takes[index], np.random.default_rng((seed, index))
        kp, kd, driven = _lead(plant)
        driven = driven if take.led else []
        low, high = _limits(plant.model)
        plant.reset(take.qpos[0], take.qvel[0], take.ctrl[0])
        rows: dict[str, list[np.ndarray]] = {k: [] for k in ("ctrl", "qpos", "qvel", "clean", "clean_v", "pull")}
        effort, pull = np.zeros(len(plant.joints)), np.zeros(plant.model.nu)
        for row in range(len(take.time)):
            clean, clean_v = plant.measure()
            q, v = self._sensed(clean, clean_v, rng) if noise else (clean, clean_v)
            u = take.ctrl[row].copy()
            for i, column, speed in driven:
                u[i] += kp[i] * (take.qpos[row, column] - q[column]) + kd[i] * (take.qvel[row, speed] - v[speed])
            u = np.clip(u, low, high)
            for key, value in zip(rows, (u, q, v, clean, clean_v, pull), strict=True):
                rows[key].append(value)
            if row + 1 < len(take.time):
                _advance(plant, take, rows["ctrl"], row)
                effort, pull = np.maximum(effort, plant.force()), plant.data.actuator_force.copy()
        return Run(time=take.time, **{k: np.array(v) for k, v in rows.items()}, effort=effort, index=index)

    def repeat(self, plant: Plant, run: Run, row: int) -> None:
        """From a row of a run to the next."""
        _advance(plant, self.takes[run.index], run.ctrl, row)

    def _sensed(self, q: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """With noise and steps of the encoders; the steps' own noise is a part of sigma."""
        quantum = np.asarray(self.quantum)
        white = np.sqrt(np.maximum(np.asarray(self.sigma) ** 2 - quantum**2 / 12, 0.0))
        seen = q + white * rng.normal(size=len(q))
        seen = np.where(quantum > 0, quantum * np.round(seen / np.where(quantum > 0, quantum, 1.0)), seen)
        return seen, v + np.asarray(self.speed_sigma) * rng.normal(size=len(v))


def _advance(plant: Plant, take: Take, sent: Sequence[np.ndarray] | np.ndarray, row: int) -> None:
    """From a row of a log to the next under the commands sent up to it, which act as late as the log says."""
    h, time = plant.timestep, take.time
    first, last = (round(float(time[k] - time[0]) / h) for k in (row, row + 1))
    if not (take.linear or take.late):
        plant.advance(sent[row], last - first)
        return
    middle = (np.arange(first, last) + 0.5) * h - take.late
    acting = np.clip(np.searchsorted(time[: row + 1] - time[0], middle + 1e-9) - 1, 0, row)
    for t, k in zip(middle, acting, strict=True):
        u = sent[k]
        if take.linear:
            ahead = sent[k + 1] if k < row else take.ctrl[row + 1]
            part = (t - (time[k] - time[0])) / (time[k + 1] - time[k])
            u = u + (ahead - u) * min(max(part, 0.0), 1.0)
        plant.advance(u, 1)


def _limits(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


def _lead(plant: Plant) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int, int]]]:
    """(gains by actuator, [(actuator, columns of its joint in positions and velocities)]) of drives without a servo."""
    model, driven = plant.model, []
    kp, kd = np.zeros((2, model.nu))
    for i in range(model.nu):
        name = model.joint(model.actuator_trnid[i, 0]).name if model.actuator_trntype[i] == 0 else ""
        if name not in plant.joints or model.actuator_biasprm[i, 1] != 0:
            continue
        strength = float(model.actuator_gainprm[i, 0] * model.actuator_gear[i, 0])
        inertia = 1 / float(model.dof_invweight0[plant.dof(name)])
        kp[i], kd[i] = inertia * LEAD**2 / strength, 1.4 * inertia * LEAD / strength
        driven.append((i, plant.column(name), plant.speed_column(name)))
    return kp, kd, driven


def strays(plant: Plant, rig: Replay, index: int) -> bool:
    """Whether the nominal robot leaves a log under the log's own commands."""
    take, run = rig.takes[index], rig.record(plant, index, 0, noise=False)
    span = np.ptp(np.concatenate([t.qpos for t in rig.takes]), axis=0)
    off = np.abs(run.clean - take.qpos).max(0)
    return bool((~np.isfinite(off) | (off > STRAY * np.maximum(span, 1e-9)))[span > 0].any())


def geoms_in_touch(plant: Plant, rig: Replay) -> tuple[str, ...]:
    """Named geoms of moving bodies that touch something at any row of the logs."""
    found: set[int] = set()
    for take in rig.takes:
        for q, v, u in zip(take.qpos[::5], take.qvel[::5], take.ctrl[::5], strict=True):
            plant.reset(q, v, u)
            found |= {int(g) for g in plant.data.contact.geom.ravel()}
    model = plant.model
    return tuple(
        model.geom(g).name for g in sorted(found) if model.geom(g).name and model.body_weldid[model.geom_bodyid[g]]
    )
