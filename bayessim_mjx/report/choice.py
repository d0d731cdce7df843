"""Figures of which one is shown at a time."""

from collections.abc import Sequence
from typing import Any


def choice(axes: Sequence[str], panels: Sequence[tuple[tuple[str, ...], dict]], start: int = 0) -> dict[str, Any]:
    """Panels of which one is shown at a time.

    Args:
        axes: names of what is chosen.
        panels: (one option per axis, figure).

    Returns:
        {"axes": [{"name", "options", "at"}], "panels": [{"keys": option numbers, "title", "figure", "shown"}]}.
    """
    options = [list(dict.fromkeys(keys[k] for keys, _ in panels)) for k in range(len(axes))]
    real = [k for k, o in enumerate(options) if len(o) > 1]  # axes with something to choose

    def shown(keys: tuple[str, ...], figure: dict, first: bool) -> dict[str, Any]:
        title = ", ".join(f"{n} {key}" for n, key in zip(axes, keys, strict=True) if key)
        return {"keys": [options[k].index(keys[k]) for k in real], "title": title, "figure": figure, "shown": first}

    return {
        "axes": [{"name": axes[k], "options": options[k], "at": options[k].index(panels[start][0][k])} for k in real],
        "panels": [shown(keys, figure, k == start) for k, (keys, figure) in enumerate(panels)],
    }
