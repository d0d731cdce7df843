"""Room for arrays. What cannot fit is refused before it is made, as an allocator that fails ends the process."""

import os
from collections.abc import Iterable
from pathlib import Path

from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import size as said

GROUP = Path("/sys/fs/cgroup/memory.max")  # a container's limit


def installed() -> float:
    """Bytes of memory that this process may have at most; infinite where the system does not say."""
    try:
        physical = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return float("inf")
    try:
        return min(physical, float(GROUP.read_text()))
    except (OSError, ValueError):  # none, or "max"
        return physical


def refuse(needs: Iterable[tuple[str, float]], room: float | None = None) -> None:
    """Check lower bounds of what is needed.

    Args:
        needs: (the settings that ask for it, with their values; bytes).
        room: bytes, default: `installed()`.

    Raises:
        UserError: naming the first that needs more than there is.
    """
    room = installed() if room is None else room
    for what, size in needs:
        if size > room:
            raise UserError(
                f"{what}: needs at least {said(size)} of memory, and there are {said(room)}; lower the number"
            )
