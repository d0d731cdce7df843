"""Logs cut into windows for multiple shooting: commands per sub-step, measured motion at each start, noise, groups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.logcheck.noise import noise_of
from bayessim_mjx.effects.support.motion import AROUND, PAST, Motion
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.resample import around as rows_around
from bayessim_mjx.logs.resample import means, resample
from bayessim_mjx.physics import controllers, staggered

Array = NDArray[np.float64]


class Batch(struct.PyTreeNode):
    """What the simulator needs of every window, leading axis W.

    Attributes:
        command: `[W, H, S, nu]`, mean over each sub-step (or over the interval centred on its beginning).
        around: Motion, `[W, 2 L + 1, ...]`, row L is the start.
        qpos: `[W, H, nq]`, qvel: `[W, H, nv]`: measured after each control step.
        drive: enabled `[W, H, nu]` or None; law `[W, nu]` or None.
    """

    command: jax.Array
    around: Motion
    qpos: jax.Array
    qvel: jax.Array
    enabled: jax.Array | None
    law: controllers.Law | None


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of one length, cut from logs on the control period.

    Attributes:
        batch: for the simulator.
        log, start, group: `[W]`, index of the log, first row in it, index of the operating condition.
        groups: names of the conditions.
        sigma_q, sigma_v: `[nv]`, noise of positions (tangent) and of velocities (inf where they are not measured in all
            logs, or not used).
        spread: `[2 nv]`, standard deviation of the measured start state.
        logs: the resampled logs.
        dt: control period, s.
        periods: s between the rows of each log as it was recorded.
        notes: what else is held out than was asked for.
        blocks: whether there is one operating condition only, and `group` is blocks of it in time.
    """

    batch: Batch
    log: NDArray[np.int64]
    start: NDArray[np.int64]
    group: NDArray[np.int64]
    groups: tuple[str, ...]
    sigma_q: Array
    sigma_v: Array
    spread: Array
    logs: tuple[Log, ...]
    dt: float
    periods: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    blocks: bool = False

    def __len__(self) -> int:
        return len(self.log)

    @property
    def steps(self) -> int:
        return int(self.batch.command.shape[1])

    @property
    def conditions(self) -> int:
        """How many operating conditions there are: one log is one, in however many blocks it is held out."""
        return 1 if self.blocks else len(self.groups)

    @property
    def condition(self) -> NDArray[np.int64]:
        """`[W]`, operating condition, for what is said of conditions; `group` is what is held out together."""
        return np.zeros_like(self.group) if self.blocks else self.group

    @property
    def measured(self) -> Array:
        """`[W]`, share of the rows compared that were measured; what lies between two rows of a log tells no more."""
        return np.minimum(1.0, self.dt / np.array(self.periods)[self.log])


def cut(
    logs: Sequence[Log],
    model: mujoco.MjModel,
    dt: float,
    substeps: int,
    length: int,
    *,
    limit: int,
    group: str | None = None,
    use_qvel: bool = True,
    starts: list[tuple[int, int]] | None = None,
    centred: bool = True,
    enough: int | None = None,
) -> Windows:
    """Windows of `length` control steps, at most `limit`, spread evenly over the logs.

    Args:
        use_qvel: compare measured velocities too (where all logs have them).
        starts: (log, row) of the windows wanted; beyond the end of a log its last row is held.
        enough: windows; where as many have a recorded past, the others are left out (`_starts`).
        centred: commands are centred on the force evaluations, where the integrator is `staggered`; False: the physics
            does that (`centred.physics_of`).

    Raises:
        UserError: no log is long enough.
    """
    even, centred = [resample(log, dt) for log in logs], centred and staggered(model)
    fine = [_fine_commands(log, e, dt, substeps, centred) for log, e in zip(logs, even, strict=True)]
    group_of, names = groups_of(logs, group)
    if starts is None:
        starts = _starts(even, length, limit, _before(PAST, dt))
        starts = starts if len(starts) == limit else _starts(even, length, limit, _before(AROUND, dt), enough)
    if not starts:
        longest = max(len(e) - 1 for e in even)
        raise UserError(
            f"no log holds {length} control steps of {dt:.4g} s; the longest has {longest}; allowed: longer logs"
        )
    blocks = len(names) == 1  # one condition only: blocks in time are held out
    names, group_of_window = _blocks(starts, even) if blocks else (names, [group_of[r] for r, _ in starts])
    batch, notes = (
        _batch(even, fine, starts, length, dt, model, controllers.of_logs(logs, model)),
        group_notes(logs, group),
    )
    sigma_q, sigma_v, spread = noise_of(even, logs, use_qvel and all(log.has_qvel for log in logs))
    return Windows(
        batch=batch,
        log=np.asarray([r for r, _ in starts]),
        start=np.asarray([a for _, a in starts]),
        group=np.asarray(group_of_window),
        groups=names,
        sigma_q=sigma_q,
        sigma_v=sigma_v,
        spread=spread,
        logs=tuple(even),
        dt=dt,
        periods=tuple(log.period for log in logs),
        notes=notes,
        blocks=blocks,
    )


def _batch(
    even: Sequence[Log],
    fine: list[NDArray[np.float32]],
    starts: list[tuple[int, int]],
    length: int,
    dt: float,
    model: mujoco.MjModel,
    law: controllers.Law | None,
) -> Batch:
    """Return the windows of `length` rows at `starts`, for the simulator."""
    around = _before(PAST, dt)
    pick = np.asarray([r for r, _ in starts])
    return Batch(
        command=_stack([fine[r][_rows(even[r], a, length)] for r, a in starts]),
        around=_around(even, fine, starts, around),
        qpos=_stack([even[r].qpos[_rows(even[r], a + 1, length)] for r, a in starts]),
        qvel=_stack([even[r].qvel[_rows(even[r], a + 1, length)] for r, a in starts]),
        enabled=_enabled(even, starts, length, model) if any(not e.enabled.all() for e in even) else None,
        law=None if law is None else jax.tree.map(lambda x: x[pick], law),
    )


def _before(seconds: float, dt: float) -> int:
    """Rows around a start that effects with memory look at."""
    return max(2, int(np.ceil(seconds / dt)))


def _starts(
    logs: Sequence[Log], length: int, limit: int, past: int, enough: int | None = None
) -> list[tuple[int, int]]:
    """(log, row) of windows one after the other, spread evenly where they are too many.

    The first of a log has `past` rows before it if `enough` remain, else as many as cost no window: which commands
    acted before a log began is not known, and what remembers them would be judged by a guess.
    """
    ends = [(r, len(log) - 1 - length) for r, log in enumerate(logs) if len(log) > length]
    every = [(r, a) for r, end in ends for a in range(min(past, end), end + 1, length)]
    if enough is None or len(every) < enough:
        every = [(r, a) for r, end in ends for a in range(min(past, end % length), end + 1, length)]
    if len(every) <= limit:
        return every
    keep = np.unique(np.linspace(0, len(every) - 1, limit).round().astype(int))
    return [every[i] for i in keep]


def _rows(log: Log, first: int, count: int) -> NDArray[np.int64]:
    return np.minimum(np.arange(first, first + count), len(log) - 1)


def _blocks(starts: list[tuple[int, int]], logs: Sequence[Log]) -> tuple[tuple[str, ...], list[int]]:
    """Up to five contiguous blocks in time, over all windows in order."""
    count = min(5, len(starts))
    of = [i * count // len(starts) for i in range(len(starts))]
    return tuple(f"part {i + 1} of {count}" for i in range(count)), of


def _fine_commands(raw: Log, even: Log, dt: float, substeps: int, centred: bool) -> NDArray[np.float32]:
    """`[rows, S, nu]`: mean of the logged command over each sub-step; centred: half a sub-step early.

    Semi-implicit Euler advances with the force at the beginning of a sub-step; read as a leapfrog (velocities half a
    sub-step before positions) that force stands for the interval centred there. With the command averaged over this
    interval the positions are second order accurate, and no delay of half a sub-step is found in anybody's data.
    """
    h = dt / substeps
    rows, nu = len(even), raw.ctrl.shape[1]
    edges = even.time[0] - centred * h / 2 + h * np.arange(rows * substeps + 1)
    fine = means(raw.time + raw.late, raw.ctrl, edges, h, (dt, dt), raw.linear)
    return fine.reshape(rows, substeps, nu).astype(np.float32)


def _around(even: Sequence[Log], fine: list, starts: list[tuple[int, int]], around: int) -> Motion:
    """Return recorded rows `a - around .. a + around`; beyond the ends of a log the end is held."""
    rows = [(r, rows_around(even[r], a, around)) for r, a in starts]
    files = [log.metadata.get("source", log.name) for log in even]  # pieces of one file share its clock
    begun = [min(o.time[0] for o, of in zip(even, files, strict=True) if of == file) for file in files]
    return Motion(
        qpos=_stack([even[r].qpos[i] for r, i in rows]),
        qvel=_stack([even[r].qvel[i] for r, i in rows]),
        command=_stack([fine[r][i] for r, i in rows]),
        start=around,
        time=_stack([np.asarray(even[r].time[a] - begun[r]) for r, a in starts]),
    )


def _enabled(even: Sequence[Log], starts: list[tuple[int, int]], length: int, model: mujoco.MjModel) -> jax.Array:
    """`[W, H, nu]`, 0 where an actuator's drive was off."""
    out = []
    for r, a in starts:
        rows = np.ones((length, model.nu))
        for name, stream in even[r].streams.items():
            if name.startswith("enabled:"):
                on = np.nan_to_num(stream[_rows(even[r], a, length)], nan=1.0) > 0.5
                rows[:, even[r].actuators.index(name.split(":", 1)[1])] = on
        out.append(rows)
    return _stack(out)


def _stack(parts: list) -> jax.Array:
    return jnp.asarray(np.stack(parts).astype(np.float32))  # by numpy: each cast of a new shape is a program


def groups_of(logs: Sequence[Log], key: str | None = None) -> tuple[list[int], tuple[str, ...]]:
    """Operating condition of each log: metadata `key`, else `condition` or `operating_condition`, else one per log.

    Pieces of one file that was cut at its gaps are one log.

    Raises:
        UserError: the key that was asked for is in no log's metadata.
    """
    labels = _labels(logs, key)
    if key and not any(labels):
        have = ", ".join(sorted({k for log in logs for k in log.metadata})) or "no keys"
        raise UserError(f"--group {key}: no log's metadata has this key; there are: {have}")
    several = len(set(labels)) > 1  # the same condition everywhere cannot be held out
    labels = [label if label and several else file for label, file in zip(labels, _files(logs), strict=True)]
    names = tuple(dict.fromkeys(labels))
    return [names.index(label) for label in labels], names


def _files(logs: Sequence[Log]) -> list[str]:
    """Each log's name; of pieces of one file that of the file."""
    sources = [str(log.metadata.get("source", log.name)) for log in logs]
    names = [(log.name.rpartition("#")[0], log.name) for log in logs]
    return [file if file and sources.count(of) > 1 else log for (file, log), of in zip(names, sources, strict=True)]


def _labels(logs: Sequence[Log], key: str | None) -> list[str]:
    """Each log's condition, "" where its metadata do not tell."""
    found = [
        log.metadata.get(key) if key else log.metadata.get("condition", log.metadata.get("operating_condition"))
        for log in logs
    ]
    return ["" if value is None else str(value) for value in found]


def group_notes(logs: Sequence[Log], key: str | None) -> tuple[str, ...]:
    """Say what is held out in place of the conditions that were asked for, where these cannot be."""
    labels = _labels(logs, key)
    if not key or not any(labels):
        return ()
    without = [log.name for log, label in zip(logs, labels, strict=True) if not label]
    if without:
        return (f"--group {key}: {', '.join(without)} without this key: each is held out as a condition of its own",)
    if len(set(labels)) > 1:
        return ()
    instead = "single logs" if len(set(_files(logs))) > 1 else "blocks of the only log in time"
    return (f"--group {key}: {labels[0]!r} in all logs, so nothing can be held out by it; {instead} are held out",)
