"""One checkpoint: a pytree of arrays and a JSON index, written by Orbax into a folder that appears whole or not at all.

The index holds every leaf's name, shape, dtype and SHA-256, and what the numbers of distributions and networks mean
(their `coordinates`): so a damaged or foreign checkpoint is recognised.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.errors import UserError

INDEX = "index.json"
FORMAT = 1
MADE_WITH = "use the task, version and settings that it was made with"
MARGIN = 1 << 19  # bytes on the disk beside the arrays of a checkpoint


class CorruptedError(UserError):
    """The checkpoint's files are damaged or incomplete."""


def save(path: Path, tree: Any, step: int, meta: Mapping[str, Any]) -> None:
    """Write `tree` as a folder that appears whole or not at all.

    Args:
        path: the folder, which must not exist.
        tree: a pytree of arrays; a dict's entries can be restored one by one.
        step, meta: kept in the index.
    """
    import jax

    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    parts = jax.device_get(_whole(tree if type(tree) is dict else {"tree": tree}))
    _need(temporary, sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(parts)))
    leaves = {name: _save_part(temporary / name, part) for name, part in parts.items()}
    index = {"format": FORMAT, "step": int(step), "meta": dict(meta), "coordinates": _coordinates(parts)}
    index["parts"] = leaves
    atomic.write_json(temporary / INDEX, {**index, "sha256": _digest(index)})
    os.rename(temporary, path)


def _need(folder: Path, size: int) -> None:
    """Refuse to begin what the disk has no room for: Orbax would fail in all of its threads at once."""
    if shutil.disk_usage(folder).free < size + MARGIN:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def _digest(content: Any) -> str:
    """Of an index without its own: a changed name or shape is damage, not another task's checkpoint."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _whole(tree: Any) -> Any:
    """Gather arrays from devices of several processes as host arrays; all of these processes have to save."""
    import jax
    from jax.experimental.multihost_utils import process_allgather

    def whole(x: Any) -> Any:
        parted = isinstance(x, jax.Array) and not x.is_fully_addressable
        return process_allgather(x, tiled=True) if parted else x

    return jax.tree.map(whole, tree)


def _checkpointer() -> Any:
    """Orbax, of this process alone."""
    import jax
    import orbax.checkpoint as ocp

    if jax.process_count() == 1:
        return ocp.PyTreeCheckpointer()
    own = jax.process_index()
    options = ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process_{own}"
    )
    handler = ocp.PyTreeCheckpointHandler(multiprocessing_options=options)
    return ocp.Checkpointer(handler, multiprocessing_options=options)


def _save_part(folder: Path, part: Any) -> list[dict[str, Any]]:
    arrays = {name: np.asarray(leaf) for name, leaf in _leaves(part)}
    # Orbax refuses arrays without elements; their shape in the index says it all.
    stored = {f"{i:06d}": array for i, array in enumerate(arrays.values()) if array.size}
    if stored:
        with _checkpointer() as checkpointer:
            checkpointer.save(folder.absolute(), stored)
    return [_describe(name, array) for name, array in arrays.items()]


def _leaves(tree: Any) -> list[tuple[str, Any]]:
    import jax

    flat = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in flat]


def _coordinates(tree: Any) -> dict[str, dict[str, Any]]:
    """Collect the `coordinates` in the tree by dotted name: its arrays do not hold them."""
    import jax

    def placed(node: Any) -> bool:
        return isinstance(getattr(node, "coordinates", None), dict)

    flat = jax.tree_util.tree_flatten_with_path(tree, is_leaf=placed)[0]
    names = [(jax.tree_util.keystr(path, simple=True, separator="."), node) for path, node in flat]
    return {name: node.coordinates for name, node in names if placed(node)}


def _describe(name: str, array: np.ndarray) -> dict[str, Any]:
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return {"name": name, "shape": list(array.shape), "dtype": str(array.dtype), "sha256": digest}


def read_index(path: Path) -> dict[str, Any]:
    """Read the index of the checkpoint `path`; CorruptedError where there is none."""
    try:
        index = json.loads((path / INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CorruptedError(f"{path}: not a checkpoint, or damaged: {INDEX}: {error}") from None
    if not isinstance(index, dict) or index.get("format") != FORMAT or "parts" not in index:
        raise CorruptedError(f"{path / INDEX}: not a checkpoint index of format {FORMAT}")
    digest = index.pop("sha256", None)  # checkpoints of earlier versions have none
    if digest is not None and digest != _digest(index):
        raise CorruptedError(f"{path / INDEX}: damaged checkpoint index: it differs from its checksum")
    parts = index["parts"]
    if not (isinstance(parts, dict) and isinstance(index.get("meta"), dict)):
        raise CorruptedError(f"{path / INDEX}: damaged checkpoint index: parts and meta have to be objects")
    for name, leaves in parts.items():
        if not (isinstance(leaves, list) and all(map(_is_leaf, leaves))):
            raise CorruptedError(f"{path / INDEX}: damaged checkpoint index: part {name!r} is no list of leaves")
    places = index.setdefault("coordinates", {})  # older ones have none
    if not (isinstance(places, dict) and all(map(_is_place, places.values()))):
        raise CorruptedError(f"{path / INDEX}: damaged checkpoint index: coordinates have to be objects")
    return index


def _is_place(place: Any) -> bool:
    """Whether it is what `Distribution.coordinates` makes, as far as it is read."""
    return isinstance(place, dict) and all(
        isinstance(place.get(key), kind)
        for key, kind in (("names", list), ("box", dict), ("priors", dict), ("chart", str))
    )


def _is_leaf(leaf: Any) -> bool:
    """Whether it is what `_describe` makes."""
    return (
        isinstance(leaf, dict)
        and all(isinstance(leaf.get(key), str) for key in ("name", "dtype", "sha256"))
        and isinstance(leaf.get("shape"), list)
        and all(type(n) is int and n >= 0 for n in leaf["shape"])
    )


def restore(path: Path, template: Any) -> tuple[Any, dict[str, Any]]:
    """(tree like `template`, meta). A dict template may name a part of it, e.g. "state.domain".

    `template` holds arrays or ShapeDtypeStructs. CorruptedError for damaged files; UserError, naming the leaf, where
    the checkpoint is that of another task or of other settings, or in other coordinates.
    """
    from bayessim_mjx.distributions.storage import disagreement

    index = read_index(path)
    wanted = template if type(template) is dict else {"tree": template}
    for name, part in wanted.items():
        if name.partition(".")[0] not in index["parts"]:
            raise UserError(f"{path}: the checkpoint has no {name!r}; it has {', '.join(index['parts'])}")
        _compare(f"{path}: {name}", _saved(index, name), part)
    for name, own in _coordinates(wanted).items():
        if words := disagreement(index["coordinates"].get(name, own), own):
            raise UserError(f"{path}: {name} {words}: {MADE_WITH}")
    tree = {name: _restore_part(path, index, name, part) for name, part in wanted.items()}
    return (tree if type(template) is dict else tree["tree"]), index["meta"]


def has(path: Path, name: str) -> bool:
    """Whether the checkpoint holds leaves under the dotted `name`."""
    index = read_index(path)
    return name.partition(".")[0] in index["parts"] and bool(_saved(index, name))


def chart(path: Path, name: str) -> str | None:
    """Read the chart of the distribution under the dotted `name`; None where the checkpoint has none (older ones)."""
    return read_index(path)["coordinates"].get(name, {}).get("chart")


def _saved(index: dict[str, Any], name: str) -> dict[int, dict]:
    """Leaves under a dotted name, by their number in the part; their names are relative to it."""
    part, _, inner = name.partition(".")
    prefix = f"{inner}." if inner else ""
    leaves = enumerate(index["parts"][part])
    return {
        i: {**leaf, "name": leaf["name"].removeprefix(prefix)} for i, leaf in leaves if leaf["name"].startswith(prefix)
    }


def _compare(where: str, saved: dict[int, dict], template: Any) -> None:
    """Refuse a template whose leaves have other names, shapes or types than the saved ones."""
    have = {leaf["name"]: f"{leaf['dtype']}{leaf['shape']}" for leaf in saved.values()}
    need = {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in _leaves(template)}
    for name in dict.fromkeys([*need, *have]):
        if need.get(name) != have.get(name):
            raise UserError(
                f"{where}.{name} is {have.get(name, 'absent')} in the checkpoint, but {need.get(name, 'absent')} under "
                f"the present settings: {MADE_WITH}"
            )


def _restore_part(path: Path, index: dict[str, Any], name: str, template: Any) -> Any:
    import jax
    import jax.numpy as jnp

    folder, saved = path / name.partition(".")[0], _saved(index, name)
    stored: dict[str, Any] = {}
    if any(0 not in leaf["shape"] for leaf in saved.values()):
        try:
            with _checkpointer() as checkpointer:
                stored = checkpointer.restore(folder.absolute())
        except Exception as error:  # a damaged file fails in many ways inside Orbax
            raise CorruptedError(f"{folder}: damaged checkpoint: {str(error).splitlines()[0][:200]}") from None
    leaves = []
    for i, leaf in saved.items():
        array = np.asarray(stored.get(f"{i:06d}", np.zeros(leaf["shape"], leaf["dtype"])))
        if _describe(leaf["name"], array) != leaf:
            raise CorruptedError(f"{folder}: damaged checkpoint: {leaf['name']} differs from its checksum")
        leaves.append(jnp.asarray(array))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
