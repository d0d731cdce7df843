"""PACE's chirps (`.pt`, as `torch.save` writes them) as recordings, read without running anything in them."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.streams import Recording, recording
from bayessim_mjx.logs.log import Array

ALLOWED = "allowed: a file of `torch.save` (PyTorch 1.6 or later) that holds a mapping of names to tensors or arrays"
STORAGES = {
    "FloatStorage": np.float32, "DoubleStorage": np.float64, "HalfStorage": np.float16, "LongStorage": np.int64,
    "IntStorage": np.int32, "BoolStorage": np.bool_,
}  # fmt: skip
WHAT = {"positions": "dof_pos", "commands": "des_dof_pos", "velocities": "dof_vel"}


class _Arrays(pickle.Unpickler):
    """Arrays and tensors, and nothing else: every other name in the file is refused."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        super().__init__(io.BytesIO(archive.read(name)))
        self.archive, self.folder = archive, name.rpartition("/")[0]

    def find_class(self, module: str, name: str) -> Any:
        known: dict[tuple[str, str], Any] = {
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("collections", "OrderedDict"): dict,
            ("numpy", "ndarray"): np.ndarray,
            ("numpy", "dtype"): np.dtype,
            ("_codecs", "encode"): _encoded,
        }
        for core in ("numpy.core.multiarray", "numpy._core.multiarray"):
            known |= {(core, "_reconstruct"): _reconstruct(), (core, "scalar"): _scalar()}
        if module == "torch" and name in STORAGES:
            return STORAGES[name]
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"{module}.{name} in a file that should hold arrays only")
        return known[module, name]

    def persistent_load(self, pid: Any) -> Array:
        return np.frombuffer(self.archive.read(f"{self.folder}/data/{Path(str(pid[2])).name}"), pid[1])


def _reconstruct() -> Callable[..., Any]:
    return np.zeros(0).__reduce__()[0]  # type: ignore[return-value]  # under its name in this NumPy


def _scalar() -> Callable[..., Any]:
    return np.float64(0).__reduce__()[0]  # type: ignore[return-value]


def _encoded(text: str, encoding: str) -> bytes:
    """Return the bytes of an array, which older pickles hold as text."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"bytes as {encoding}")
    return text.encode(encoding)


def _tensor(data: Array, start: int, shape: Sequence[int], strides: Sequence[int], *rest: Any) -> Array:
    """Copy a tensor's values; a shape that reaches beyond its storage is refused."""
    end = start + sum((n - 1) * s for n, s in zip(shape, strides, strict=True))
    if min([start, *shape, *strides]) < 0 or (0 not in shape and end >= len(data)):
        raise pickle.UnpicklingError("a tensor that reaches beyond its storage")
    if 0 in shape:
        return np.zeros(tuple(shape))
    steps = [s * data.itemsize for s in strides]
    return np.lib.stride_tricks.as_strided(data[start:], tuple(shape), steps).copy()


def arrays(path: Path) -> dict[str, Array]:
    """Return the arrays of a `.pt` file, by name.

    Raises:
        UserError: no such file, something in it that is no array.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            found = next(n for n in archive.namelist() if n.rpartition("/")[2] == "data.pkl")
            content = _Arrays(archive, found).load()
        if not isinstance(content, Mapping):
            raise pickle.UnpicklingError(f"a {type(content).__name__} in place of a mapping")
        return {str(k): np.asarray(v) for k, v in content.items()}
    except Exception as error:  # pickle, zipfile and numpy each raise their own kinds for a broken file
        raise UserError(f"{path}: not readable ({type(error).__name__}: {error}); {ALLOWED}") from None


def of_file(path: Path, joints: Sequence[str]) -> Recording:
    """Read a file of `time` [T], `dof_pos`, `des_dof_pos` [T, n] and, where there are some, `dof_vel`, kp and kd.

    Args:
        path: of the file.
        joints: names of the columns, in their order; the file has none.

    Raises:
        UserError: no times, positions or targets; no names, or another number of them.
    """
    found = arrays(path)
    lost = [key for key in ("time", WHAT["positions"], WHAT["commands"]) if key not in found]
    if lost:
        raise UserError(f"{path}: no {', '.join(lost)}; it has {', '.join(found)}; allowed: time, dof_pos, des_dof_pos")
    count = found["dof_pos"].shape[-1]
    if len(joints) != count:
        given = f"--joints names {len(joints)}" if joints else "it does not name them"
        raise UserError(
            f"{path}: {count} columns of joints, {given}; allowed: --joints with {count} names in their order"
        )
    values = {what: found[key].astype(float) for what, key in WHAT.items() if key in found}
    gains = {k: np.broadcast_to(np.ravel(found[k]), count) for k in ("kp", "kd") if k in found}
    if {"kp", "kd"} <= set(gains) and "des_dof_vel" in found:
        values["commands"] += found["des_dof_vel"] * gains["kd"] / gains["kp"]  # kd dq* as a part of kp q*
    laws = {
        joint: {"law": "position", **{k: float(g[i]) for k, g in gains.items()}} for i, joint in enumerate(joints)
    } if "kp" in gains else {}  # fmt: skip
    notes = [] if laws else [f"{path.name}: it has no kp and kd: where the model takes torques, declare the controller"]
    names = {what: joints for what in values}
    return recording(path.stem, np.ravel(found["time"]).astype(float), values, names, notes, laws)


__all__ = ["arrays", "of_file"]
