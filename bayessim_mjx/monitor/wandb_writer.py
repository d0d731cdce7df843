"""Weights & Biases: scalars, pictures, videos and settings of a run; a resumed run goes on in the same one there.

Which project, entity and mode (`offline`, say) is `wandb`'s own business: WANDB_PROJECT, WANDB_ENTITY, WANDB_MODE.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor.writer import number

ID = "wandb_id.txt"  # in the run's folder: which run it is there
PROJECT = "bayessim-mjx"  # where WANDB_PROJECT does not say otherwise
_open: dict[Path, Any] = {}  # folder of a run -> (its run there, how many write to it)


class WandbWriter:
    """One of a run's axes: tags stand under `name`, over its own steps `<name>/step`.

    Args:
        folder: of the run; all writers of one share a run there.
        name: of the axis, e.g. "rl"; "": the only one.

    Raises:
        UserError: wandb is not installed, or refuses the run: nobody logged in, say.
    """

    def __init__(self, folder: Path, name: str = "") -> None:
        self.folder, self.prefix = folder, f"{name}/" if name else ""
        self.run, self._closed = _taken(folder), False
        self.run.define_metric(f"{self.prefix}step", hidden=True)
        self.run.define_metric(f"{self.prefix}*", step_metric=f"{self.prefix}step")

    def _log(self, step: int, values: Mapping[str, Any]) -> None:
        named = {f"{self.prefix}{tag}": value for tag, value in values.items()}
        self.run.log({**named, f"{self.prefix}step": int(step)})

    def scalars(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        found = {prefix + tag: number(prefix + tag, value) for tag, value in values.items()}
        if kept := {tag: value for tag, value in found.items() if value is not None}:
            self._log(step, kept)

    def text(self, tag: str, text: str, step: int = 0, code: bool = False) -> None:
        """Write a text; settings (`code`) become the run's configuration there."""
        if code:
            import yaml

            self.run.config.update({tag: yaml.safe_load(text)}, allow_val_change=True)

    def figure(self, tag: str, figure: Any, step: int) -> None:
        import wandb
        from PIL import Image

        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        self._log(step, {tag: wandb.Image(Image.open(buffer))})

    def video(self, tag: str, frames: np.ndarray | None, fps: float, step: int) -> None:
        if frames is None:
            return
        import wandb

        from bayessim_mjx.monitor import video

        path = self.folder / "videos" / f".wandb_{tag.replace('/', '_')}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        if video.save(frames, path, fps):  # else there is no file, or that of an earlier video
            self._log(step, {tag: wandb.Video(str(path), format="mp4")})

    def flush(self) -> None:
        """wandb sends by itself."""

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            _left(self.folder)


def _taken(folder: Path) -> Any:
    """Begin, or continue, the run there of a folder."""
    if folder in _open:
        run, users = _open[folder]
        _open[folder] = run, users + 1
        return run
    try:
        import wandb
    except ImportError as error:
        raise UserError(f"monitor.writers: wandb is missing: pip install 'bayessim-mjx[wandb]' ({error})") from error
    import os

    kept = folder / ID
    known = kept.read_text().strip() if kept.is_file() else None
    project = os.environ.get("WANDB_PROJECT", PROJECT)
    try:
        run = wandb.init(project=project, name=folder.name, id=known, resume="allow", dir=str(folder))
    except wandb.Error as error:  # nobody logged in, no connection
        raise UserError(
            f"monitor.writers: wandb: {error}; WANDB_MODE=offline keeps the run in its folder until `wandb sync`"
        ) from error
    kept.write_text(run.id + "\n")
    _open[folder] = run, 1
    return run


def _left(folder: Path) -> None:
    run, users = _open.pop(folder)
    if users > 1:
        _open[folder] = run, users - 1
    else:
        run.finish()
