"""Folders that flags name: one that results go to, and one that holds a run."""

import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from bayessim_mjx import trust
from bayessim_mjx.cli.commands import SCRIPT, prog_of
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


def run_to_resume(folder: str | Path, command: str) -> "Run":
    """Return the run that `command` is to go on with.

    Raises:
        UserError: there is no run, or another command made it; with the command that goes on with it.
    """
    run = open_run(folder, "--resume")
    script, made, *_ = [*shlex.split(str(run.manifest.get("command", ""))), "", ""]
    if script != SCRIPT or made not in ("main", "train") or made == command:
        return run
    own = f"`{prog_of(made)} --resume {run.path}{trust.flags()}` goes on with it"
    longer = f"`{prog_of('train')} --domain {run.path} --checkpoint {run.path}{trust.flags()}`"
    more = f"; {longer} trains its policy further, under its posterior" if made == "main" else ""
    raise UserError(f"--resume {folder}: this is a run of {made}, not of {command}; {own}{more}")
