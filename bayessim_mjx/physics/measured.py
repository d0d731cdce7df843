"""What `bayessim-mjx implementations` measured on this machine: one small file of JSON in the user's cache folder."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx.config import loading
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import compact
from bayessim_mjx.versions import of

FILE = "implementations.json"
FORMAT = 1
VERSIONS = ("mujoco-mjx", "jax", "warp-lang")  # told in the file
DECIDING = ("mujoco-mjx", "warp-lang")  # with others of these a measurement says nothing


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Control steps per second of all worlds together, by each implementation; None: it could not.

    Args:
        task: its name.
        device: its kind, as JAX calls it.
        worlds: how many were simulated together.
        versions: of the packages VERSIONS.
    """

    task: str
    device: str
    worlds: int
    jax: float | None
    warp: float | None
    versions: Mapping[str, str]

    @property
    def faster(self) -> str:
        """`warp` or `jax`."""
        return "warp" if (self.warp or 0.0) > (self.jax or 0.0) else "jax"


def rate(value: float) -> str:
    """Return steps per second in few characters: `3848`, `655k`, `4.82M`."""
    return compact(value, 3 if value >= 1e4 else 4)


def path() -> Path | None:
    """Where measurements are kept; None: they are not."""
    folder = loading.cache_folder()
    return None if folder is None else folder / FILE


def read(file: Path | None) -> tuple[Measurement, ...]:
    """Return the measurements in `file`; none where there is no file.

    Raises:
        UserError: it cannot be read, or holds something else.
    """
    if file is None:
        return ()
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        if found["format"] != FORMAT:
            raise ValueError(f"format {found['format']}, expected {FORMAT}")
        return tuple(_checked(Measurement(**row)) for row in found["measured"])
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{file}: not a file of measurements ({error}); delete it and measure anew") from None


def _checked(m: Measurement) -> Measurement:
    rates = [r for r in (m.jax, m.warp) if r is not None]
    if not (isinstance(m.worlds, int) and m.worlds > 0 and all(math.isfinite(r) and r > 0 for r in rates)):
        raise ValueError(f"{m.task} with {m.worlds} worlds: {m.jax}, {m.warp}")
    return dataclasses.replace(m, versions=dict(m.versions))


def content(kept: Iterable[Measurement]) -> dict[str, Any]:
    """Return the content of the file."""
    ordered = sorted(kept, key=lambda m: (m.task, m.device, m.worlds))
    return {"format": FORMAT, "measured": [dataclasses.asdict(m) for m in ordered]}


def with_new(kept: Iterable[Measurement], new: Measurement) -> tuple[Measurement, ...]:
    """Return the measurements with a further one, in place of what was measured for the same before."""
    same = (new.task, new.device, new.worlds)
    return (*(m for m in kept if (m.task, m.device, m.worlds) != same), new)


def current(kept: Iterable[Measurement], task: str, device: str) -> list[Measurement]:
    """Those of a task on a kind of device that these versions made, fewest worlds first."""
    now = of(DECIDING)
    known = (m for m in kept if (m.task, m.device) == (task, device))
    valid = [m for m in known if all(m.versions.get(name) == version for name, version in now.items())]
    return sorted(valid, key=lambda m: m.worlds)
