"""Whose code runs: files of code that the user names on the command line or in a program, never one that data name.

Settings files, run folders, effects.yaml and diagnosis.json may come from anybody; see docs/trust.md.
"""

import os
from collections.abc import Iterable
from pathlib import Path

from bayessim_mjx.errors import UserError

FLAG = "--allow_code"
_named: set[Path] = set()


def allow(files: Iterable[str | os.PathLike]) -> None:
    """Files whose code may run in this process, whoever asks for it."""
    _named.update(Path(file).expanduser().resolve() for file in files)


def check(file: Path, spec: str) -> None:
    """UserError where the user has not named `file`, which a settings file asks for as `spec`."""
    if file.resolve() not in _named:
        raise UserError(
            f"effect {spec!r}: settings name code of yours, which runs only where you name it too; read {file}, then "
            f"give {FLAG} {file} (docs/trust.md)"
        )
