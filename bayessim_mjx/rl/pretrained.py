"""Policies that come with the package: small files beside this one, by task, each with its checksum.

`released/index.json` says how each was trained and which return it reached. docs/release_policy.py writes both.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.rl.networks import Policy
from bayessim_mjx.rl.normalise import Moments

FOLDER = Path(__file__).with_name("released")
INDEX = "index.json"
# what a policy is beside its arrays
KEPT = ("activation", "normalize", "action_clip", "squash", "std_range", "beta")


def names(folder: Path = FOLDER) -> tuple[str, ...]:
    """List the tasks that a policy comes for."""
    return tuple(_index(folder))


def about(task: str, folder: Path = FOLDER) -> dict[str, Any]:
    """Describe the policy of `task`: file, sha256, settings, command, versions, and its return.

    `return` has mean and sd over `episodes` episodes at nominal physics.

    Raises:
        UserError: there is no policy for `task`.
    """
    index = _index(folder)
    known = {title.lower(): title for title in index}
    title = known.get(task.lower().replace("_", ""))
    if title is None:
        raise UserError(f"pretrained {task!r}: policies come for {', '.join(index)}; train makes one for any task")
    return index[title]


def pretrained(task: str, folder: Path = FOLDER) -> Policy:
    """Load the policy for `task` that comes with the package; it acts on the task at its default settings.

    Args:
        task: a task's name; case and underscores do not matter.
        folder: where `index.json` and the files are.

    Raises:
        UserError: there is no policy for `task`, or its file is damaged.
    """
    facts = about(task, folder)
    path = folder / facts["file"]
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: the policy cannot be read ({error.strerror}); install the package again") from None
    digest = hashlib.sha256(content).hexdigest()
    if digest != facts["sha256"]:
        raise UserError(
            f"{path}: damaged: its SHA-256 is {digest}, and {INDEX} says {facts['sha256']}; install the package again"
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        tree = _tree({name: jnp.asarray(file[name]) for name in file.files})
    kept: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in facts["settings"].items()
    }
    return Policy(tree["actor"], Moments(**tree["normalizer"]), **kept)


def write(policy: Policy, task: str, facts: Mapping[str, Any], folder: Path = FOLDER) -> Path:
    """Write a policy and its row of the index; `facts`: what is known of it. Returns the file."""
    flat = jax.tree_util.tree_flatten_with_path({"actor": policy.actor, "normalizer": policy.normalizer})[0]
    arrays = {jax.tree_util.keystr(at, simple=True, separator="."): np.asarray(leaf) for at, leaf in flat}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{task.lower()}.npz"
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    row = {"file": path.name, "sha256": digest, "settings": {name: getattr(policy, name) for name in KEPT}, **facts}
    rows = (_index(folder) if (folder / INDEX).exists() else {}) | {task: row}
    (folder / INDEX).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return path


def _index(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{folder / INDEX}: the list of policies cannot be read: {error}") from None


def _tree(flat: Mapping[str, Any]) -> Any:
    """Nested dicts and lists from dotted names; what is numbered is a list."""
    groups: dict[str, dict[str, Any]] = {}
    for name, leaf in flat.items():
        head, _, rest = name.partition(".")
        groups.setdefault(head, {})[rest] = leaf
    tree = {head: inner[""] if "" in inner else _tree(inner) for head, inner in groups.items()}
    return [tree[str(k)] for k in range(len(tree))] if all(map(str.isdigit, tree)) else tree
