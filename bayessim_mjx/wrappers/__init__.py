"""Our environments for the trainers of other libraries.

In Gymnasium our tasks are called `bayessim_mjx/<Task>-v0`. `import bayessim_mjx` says so to Gymnasium, at once or when
Gymnasium is imported; nothing heavy is imported for it.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from bayessim_mjx.task_names import names

NAMESPACE = "bayessim_mjx"
_MODULE = f"{__name__}.gymnasium"


def register() -> None:
    """Make `gymnasium.make` and `gymnasium.make_vec` know our tasks; a second call does nothing."""
    import gymnasium

    for task in names():
        if (name := f"{NAMESPACE}/{task}-v0") not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{_MODULE}:make",
                vector_entry_point=f"{_MODULE}:make_vec",
                kwargs={"task": task},
            )


class _WhenImported:
    """A finder that registers the tasks as soon as Gymnasium has been imported, and then goes."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "gymnasium" or self not in sys.meta_path:
            return None
        sys.meta_path.remove(self)  # type: ignore[arg-type]
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            whole = spec.loader.exec_module

            def exec_module(module: Any) -> None:
                whole(module)
                register()

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def announce() -> None:
    """`register` now, or when Gymnasium is imported."""
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _WhenImported())  # type: ignore[arg-type]
