"""Sources of observations, computed from a logged state at any instant and in any frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.recording import Run

Array = NDArray[np.float64]
FRAMES = ("world", "body", "inverse", "order")  # mistakes: other axes, the inverse rotation, quaternion in other order
NEXT = 1.5  # row periods between two samples of a channel that follow each other; a rule of thumb
VECTORS = ("gravity", "turning", "turning_world", "velocity", "velocity_world")


def rotations(quat: Array) -> Array:
    """[K, 3, 3], body to world, of quaternions [K, 4], w x y z."""
    w, x, y, z = (quat / np.linalg.norm(quat, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


class State:
    """The logged state of one run at the steps of the policy, `late` s ago."""

    def __init__(self, run: Run, late: float) -> None:
        self.run, self.at = run, run.time - late

    def channel(self, name: str) -> Array | None:
        """[K] of a logged channel, interpolated; NaN before the log begins; None where it was not logged.

        A velocity of a joint that was not logged is the slope of its position.
        """
        values = self.run.channels.get(name)
        if values is None and name.startswith("qvel:") and "[" not in name:
            place = self.run.channels.get(f"qpos:{name[5:]}")
            values = None if place is None else np.gradient(place, self.run.rows)
        if values is None or np.isfinite(values).sum() < 2:
            return None
        good = np.isfinite(values)
        rows = self.run.rows[good]
        out = np.interp(self.at, rows, values[good], left=np.nan)
        if good.all():
            return out
        # between samples of a sensor that is read less often than the log nothing is known
        after = np.clip(np.searchsorted(rows, self.at - 1e-9), 1, len(rows) - 1)
        hit = np.minimum(np.abs(rows[after] - self.at), np.abs(rows[after - 1] - self.at)) < 1e-6
        close = rows[after] - rows[after - 1] < NEXT * np.median(np.diff(self.run.rows))
        return np.where(hit | close, out, np.nan)

    def _joint(self, stream: str, joint: str, indices: Sequence[int]) -> Array | None:
        """[K, n] of a joint with several numbers."""
        columns = [self.channel(f"{stream}:{joint}[{i}]") for i in indices]
        found = [c for c in columns if c is not None]
        return np.stack(found, 1) if len(found) == len(columns) else None

    def quaternion(self, joint: str) -> Array | None:
        """[K, 4], w x y z, without flips of the sign."""
        free = f"qpos:{joint}[6]" in self.run.channels
        found = self._joint("qpos", joint, range(3, 7) if free else range(4))
        if found is None:
            return None
        flips = np.cumprod(np.where(np.nansum(found[1:] * found[:-1], axis=1) < 0, -1.0, 1.0))
        return found * np.append(1.0, flips)[:, None]

    def vector(self, kind: str, joint: str, frame: str = "") -> Array | None:
        """[K, 3] of gravity, turning or velocity.

        Args:
            kind: of VECTORS. frame: "" as the kind says, or one of FRAMES.
        """
        quat = self.quaternion(joint)
        turn = None if quat is None else rotations(np.roll(quat, 1, axis=1) if frame == "order" else quat)
        if kind == "gravity":
            if turn is None or frame == "body":
                return None
            down = np.zeros((len(turn), 3)) - np.eye(3)[2]
            return down if frame == "world" else -turn[:, :, 2] if frame == "inverse" else -turn[:, 2, :]
        indices = range(3) if kind.startswith("velocity") else self._gyroscope(joint)
        logged = self._joint("qvel", joint, indices)
        if logged is None:
            return None
        stored = (
            "world" if kind.startswith("velocity") else "body"
        )  # MuJoCo's: linear in the world, angular in the body
        own = "world" if kind.endswith("_world") else "body"
        wanted = {"": own, "order": own}.get(frame, frame)
        if wanted == stored and frame != "order":
            return logged
        if turn is None or (frame == "order" and own == stored):
            return None
        forward = (wanted == "world") if wanted != "inverse" else stored == "world"
        return np.einsum("kij,kj->ki" if forward else "kji,kj->ki", turn, logged)

    def _gyroscope(self, joint: str) -> Sequence[int]:
        return range(3, 6) if f"qvel:{joint}[5]" in self.run.channels else range(3)

    def source(self, name: str, frame: str = "") -> Array | None:
        """[K] of a source of the manifest; None where the log has not what it follows from."""
        kind, _, rest = name.partition(":")
        joint, _, axis = rest.rpartition(".")
        if kind in VECTORS:
            found = self.vector(kind, joint, frame)
            return None if found is None else found[:, "xyz".index(axis)]
        if frame:
            return None
        if kind == "quaternion":
            quat = self.quaternion(joint)
            return None if quat is None else quat[:, "wxyz".index(axis)]
        if kind == "position":
            return self.channel(f"qpos:{joint}[{'xyz'.index(axis)}]")
        if kind in ("sin", "cos"):
            angle = self.channel(f"qpos:{rest}")
            return None if angle is None else (np.sin if kind == "sin" else np.cos)(angle)
        return self.channel(name)

    def entry(self, entry: Entry, frame: str = "") -> Array | None:
        """[K] of an observation as the manifest says it; None where a source was not logged."""
        if not entry.terms:
            return None
        parts = {name: self.source(name, frame) for name in entry.terms}
        found = [entry.terms[name] * values for name, values in parts.items() if values is not None]
        return None if len(found) < len(parts) else np.sum(found, axis=0) + entry.offset
