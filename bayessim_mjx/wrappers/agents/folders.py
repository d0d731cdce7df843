"""The folder of a checkpoint of another library, which is whole at every moment: a kill may come at any of them."""

import shutil
from collections.abc import Callable
from pathlib import Path

NEW, OLD = ".new", ".old"  # versions of a folder, while one takes the other's place


def write(folder: Path, save: Callable[[Path], None]) -> None:
    """Write `save`'s files into an empty folder that then becomes `folder`, in place of what was there."""
    new, old = folder.with_suffix(NEW), folder.with_suffix(OLD)
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    save(new)
    if folder.is_dir():
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    new.rename(folder)


def kept(folder: Path) -> Path:
    """Find the folder, or its last version where a kill came before the new one was in its place."""
    return folder if folder.is_dir() else folder.with_suffix(OLD)


def clear(parent: Path, steps: set[str]) -> None:
    """Remove all folders in `parent` but those of these checkpoints."""
    for folder in parent.iterdir():
        if folder.name not in steps:
            shutil.rmtree(folder, ignore_errors=True)
