"""Traced programs that survive the process: tracing and lowering are half of a warm diagnosis of a small robot.

JAX's own cache keeps what XLA compiled under the lowered program, which has to be traced first. Here lowered programs
are kept (`jax.export`) under what they were traced from: the model, the effects, the arguments' shapes, the sources of
this package and the versions of JAX and MuJoCo.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jax import export

from bayessim_mjx import atomic, versions
from bayessim_mjx.compat import compiler_options
from bayessim_mjx.config import loading
from bayessim_mjx.physics import Physics

FOLDER = "programs"


class Kept:
    """`jax.jit(function)` of arrays in pytrees, traced once for all processes.

    Args:
        function: pure; what it closes over has to be in `traced_from`.
        traced_from: all that the program depends on besides its arguments' shapes; None: nothing is kept.
    """

    def __init__(self, function: Callable[..., Any], traced_from: str | None) -> None:
        self.function, self.traced_from = function, traced_from
        self._known: dict[Any, Callable[..., Any]] = {}

    @property
    def count(self) -> int:
        """Programs called so far, one for each set of shapes."""
        return len(self._known)

    def __call__(self, *args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        return self._program(leaves, tree)(*leaves)

    def _program(self, leaves: list[Any], tree: Any) -> Any:
        shapes = tuple((np.shape(x), str(jax.dtypes.canonicalize_dtype(np.result_type(x)))) for x in leaves)
        if (tree, shapes) not in self._known:
            if self.traced_from is None:
                found = self._flat(tree)
            else:
                own = self.traced_from, str(tree), str(shapes), jax.default_backend(), _versions(), versions.sources()
                found = self._from_disk(_digest(own), leaves, tree)
            self._known[tree, shapes] = found
        return self._known[tree, shapes]

    def _flat(self, tree: Any) -> Any:
        def flat(*leaves: Any) -> Any:
            return self.function(*jax.tree.unflatten(tree, leaves))

        return jax.jit(flat, compiler_options=compiler_options(level=None))

    def _from_disk(self, name: str, leaves: list[Any], tree: Any) -> Any:
        folder = loading.cache_folder()
        path = None if folder is None else folder / FOLDER / name
        try:
            exported = export.deserialize(bytearray(path.read_bytes())) if path is not None else None
        except Exception:  # none, half a file, or of a JAX that wrote another format
            exported = None
        if exported is None:
            own = self._flat(tree)
            try:
                exported = export.export(own)(*leaves)
                _write(path, bytes(exported.serialize()))
            except (ValueError, NotImplementedError, OSError):  # a custom call that JAX does not promise to keep
                return own
        return jax.jit(exported.call, compiler_options=compiler_options(level=None))


def traced_from(physics: Physics, *more: Any) -> str | None:
    """Describe what a program of a physics is traced from; None for effects without a source file."""
    size = mujoco.mj_sizeModel(physics.mj_model)
    model = np.empty(size, np.uint8)
    mujoco.mj_saveModel(physics.mj_model, None, model)
    sources = {source_of(type(effect)) for effect in physics.effects}
    if None in sources:
        return None
    own = physics.effects, physics.model_space.parameters, physics.substeps, physics.max_qvel, physics.unroll
    return _digest([hashlib.sha256(model.tobytes()).hexdigest(), *sorted(map(str, sources)), repr(own), repr(more)])


def source_of(of: type) -> str | None:
    """Digest of the file that a class comes from; of this package's, nothing (`versions.sources`)."""
    if of.__module__.split(".")[0] == __package__:
        return ""
    try:
        return _digest([Path(inspect.getfile(of)).read_text()])
    except (OSError, TypeError):
        return None


@functools.cache
def _versions() -> str:
    import jaxlib
    from mujoco import mjx

    return f"{jax.__version__} {jaxlib.__version__} {mujoco.__version__} {getattr(mjx, '__version__', mjx.__file__)}"


def _digest(texts: Iterable[str]) -> str:
    found = hashlib.sha256()
    for text in texts:
        found.update(text.encode() + b"\0")
    return found.hexdigest()


def _write(path: Path | None, content: bytes) -> None:
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_bytes(path, content)
