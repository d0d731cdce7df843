"""Folders that flags name: one that results go to, and one that holds a run."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from bayessim_mjx.runs import Run


def writable(folder: str | Path, flag: str) -> None:
    """Refuse a folder that cannot be made or written, before anything is computed for it.

    Raises:
        UserError: naming the flag and what stands in the way.
    """
    path = Path(folder).expanduser().absolute()
    above = next(p for p in (path, *path.parents) if p.exists())
    if not above.is_dir():
        what = "there is a file of that name; give a folder" if above == path else f"{above} is a file; give a folder"
        raise UserError(f"{flag} {folder}: {what}")
    try:
        tempfile.TemporaryDirectory(dir=above, prefix=".bayessim_mjx_").cleanup()
    except OSError as error:
        raise UserError(f"{flag} {folder}: {above} cannot be written ({error.strerror}); give another folder") from None


def open_run(folder: str | Path, flag: str) -> "Run":
    """Return the run in a folder.

    Raises:
        UserError: naming the flag; there is no run, or it is damaged.
    """
    from bayessim_mjx.runs import MANIFEST, Run

    try:
        return Run.open(folder)
    except UserError:
        if (Path(folder) / MANIFEST).is_file():
            raise
    raise UserError(
        f"{flag} {folder}: not a run folder (no {MANIFEST} in it); give the folder that a run prints at its start, "
        "<logdir>/<Task>/<date>"
    )
