"""Progress bars with the time to go, on a terminal."""

from typing import Any

from bayessim_mjx.quantities import duration

LONGEST = "ETA 59 min 59 s"  # room that the time to go may take


class Bars:
    """Bars by kind (`round`, `phase`) on a rich console of `width` columns; they go away at the end."""

    def __init__(self, console: Any, width: int):
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

        self.width, self.bar = width, 24 if width >= 120 else 10
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description:<14}"),
            BarColumn(self.bar),
            TextColumn("{task.fields[count]}"),
            TextColumn("{task.fields[eta]}"),
            TextColumn("{task.fields[note]}"),
        )
        self._progress = Progress(*columns, console=console, transient=True)
        self._progress.start()
        self._tasks: dict[str, Any] = {}

    def __contains__(self, kind: str) -> bool:
        return kind in self._tasks

    def show(self, kind: str, text: str, total: int | None, done: int) -> None:
        """Show a new bar, in place of the last one of its kind."""
        if kind in self._tasks:
            self._progress.remove_task(self._tasks[kind])
        self._tasks[kind] = self._progress.add_task(
            text, total=total, completed=done, eta="", note="", count=_count(done, total)
        )

    def move(self, kind: str, done: int | None, note: str, eta: float | None, text: str | None = None) -> None:
        if kind not in self._tasks:
            return
        more: dict[str, Any] = {} if text is None else {"description": text}
        if done is not None:
            [total] = [task.total for task in self._progress.tasks if task.id == self._tasks[kind]]
            more["count"] = _count(done, total)
        from rich.markup import escape

        said = f"ETA {duration(eta)}" if eta else ""
        self._progress.update(self._tasks[kind], completed=done, note=escape(note), eta=said, **more)

    def note_room(self) -> int:
        """Columns beside spinner, description, bar, count and time to go, each as wide as its widest."""
        tasks = self._progress.tasks
        said = max(14, *(len(task.description) for task in tasks))
        count = max((len(_count(task.total, task.total)) for task in tasks), default=0)
        return self.width - (1 + said + self.bar + count + len(LONGEST) + 6)

    def close(self) -> None:
        self._progress.stop()


def _count(done: float | None, total: float | None) -> str:
    return f"{done:.0f}/{total:.0f}" if total and done is not None else ""
