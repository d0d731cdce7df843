"""What a finished blind check says to a diagnosis of the same robot and logs."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from bayessim_mjx.errors import UserError

FILE, PAGE = "blind.json", "blind.html"
FOLDER = "blind"  # where a check lies beside logs


@dataclasses.dataclass(frozen=True)
class Missed:
    """Sentences on what would have been missed, how many cases they rest on, and the page that has it all."""

    sentences: tuple[str, ...]
    cases: int
    page: Path


def recall(folder: str | Path) -> Missed:
    """Read the check in a folder.

    Raises:
        UserError: there is none.
    """
    path = Path(folder) / FILE
    if not path.is_file():
        raise UserError(f"--blind {folder}: no {FILE} there; give the --out folder of a finished blind check")
    found = json.loads(path.read_text(encoding="utf-8"))
    return Missed(tuple(found["sentences"]), int(found["cases"]), path.with_name(PAGE).resolve())


def beside(data: Sequence[str]) -> Missed | None:
    """Read the check of these very logs that lies in a folder `blind` beside them; None: there is none."""
    wanted = {Path(p).resolve() for p in data}
    for folder in {Path(p).resolve().parent / FOLDER for p in data}:
        try:
            settings = json.loads((folder / FILE).read_text(encoding="utf-8"))["settings"]
        except (OSError, ValueError, KeyError):
            continue
        if {Path(p).resolve() for p in settings["data"]} == wanted and not settings["command"]:
            return recall(folder)
    return None
