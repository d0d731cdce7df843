"""Lines, tables and frames on a terminal, or in a file that is to be searched; progress bars on a terminal."""

import os
import time
from collections.abc import Collection, Sequence
from typing import Any, TextIO

from bayessim_mjx.monitor.tables import TIE, shell, table, wrapped
from bayessim_mjx.quantities import ascii_of, duration

FILE_WIDTH = 140  # columns that tables and lists may take where there is no terminal
LEAST_WIDTH = 40  # narrower terminals break words
LONGEST = "ETA 59 min 59 s"  # room that the time to go may take beside numbers
HIDDEN = 2.0  # s of a step without a known end before the bar shows how long it has run


class Output:
    """Where a command's lines go; `live`: to a terminal, with colours, unless `headless`."""

    def __init__(self, headless: bool, file: TextIO):
        from rich.console import Console as RichConsole

        self.live = not headless and bool(getattr(file, "isatty", lambda: False)())
        options: dict[str, Any] = dict(file=file, highlight=False, soft_wrap=True)
        self._columns = int(c) if (c := os.environ.get("COLUMNS", "")).isdigit() else None  # as rich reads it
        if not self.live:
            options |= dict(force_terminal=False, no_color=True, width=self._columns or FILE_WIDTH)
        self.rich = RichConsole(**options)
        self._unicode = "utf" in (getattr(file, "encoding", None) or "utf-8").lower()
        self._blank, self.written = False, 0

    @property
    def width(self) -> int:
        """Columns that tables and lists may take."""
        return max(self.rich.width, LEAST_WIDTH)

    @property
    def limit(self) -> int | None:
        """Columns at which lines are broken; None: they are not."""
        return self.width if self.live or self._columns else None

    def grid(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[str]],
        title: str | None = None,
        left: Collection[int] = (0,),
    ) -> None:
        """Print a table of texts: the columns `left` hold words, the others numbers. See `tables.table`."""
        plain = [[self.plain(cell) for cell in row] for row in (header, *rows)]
        laid = table(plain[0], plain[1:], self.width, left)
        if not self._blank:
            self.line("")
        for line in wrapped(self.plain(title), self.limit) if title else []:
            self.line(line, "italic")
        for line in laid.header:
            self.line(line, "bold")
        self.line(("─" if self._unicode else "-") * max(map(len, [*laid.header, *laid.rows])))
        for line in laid.rows:
            self.line(line)
        self.line("")

    def panel(self, title: str, lines: Sequence[tuple[str, str]], colour: str) -> None:
        """Print a frame of `colour` round lines of (text, style), with a title."""
        from rich import box
        from rich.panel import Panel
        from rich.text import Text

        parts = [(part, style) for text, style in lines for part in wrapped(self.plain(text), self.width - 4)]
        body = Text("\n").join(Text(part, style) for part, style in parts)
        edge = box.ROUNDED if self._unicode else box.ASCII
        name = Text(self.plain(title), f"bold {colour}")
        self.rich.print(Panel(body, title=name, title_align="left", border_style=colour, box=edge), soft_wrap=False)

    def command(self, what: str, command: str) -> None:
        """Print a command that the user may want to paste, on lines of its own: it stays whole, whatever the width."""
        self.say(f"{what}:")
        for line in shell(command, self.limit, 2):
            self.line(line)

    def plain(self, text: str) -> str:
        """Keep what can be written in the encoding of the file."""
        return text if self._unicode else TIE.join(map(ascii_of, text.split(TIE)))

    def broken(self, text: str, indent: int) -> list[str]:
        """`text` in lines that fit; those after the first are indented."""
        return wrapped(self.plain(text), self.limit, indent)

    def say(self, text: str, style: str = "", indent: int = 4) -> None:
        """Print a line, or a paragraph whose later lines are indented."""
        for line in self.broken(text, indent):
            self.line(line, style)

    def facts(self, facts: Sequence[str], style: str) -> None:
        """Short texts in a row, on as many lines as it takes; one that fits on a line is not broken."""
        lines = [facts[0]]
        for fact in facts[1:]:
            if self.limit is None or len(lines[-1]) + 3 + len(fact) <= self.limit:
                lines[-1] += f"   {fact}"
            else:
                lines.append(f"    {fact}")
        for line in lines:
            self.say(line, style, 6)

    def line(self, text: str, style: str = "", styled: int | None = None) -> None:
        """Print one line as it is; on a terminal the first `styled` characters (default: all) in `style`."""
        from rich.text import Text

        line, self._blank = Text(self.plain(text)), not text
        self.written += 1
        if self.live and style:
            line.stylize(style, 0, styled)
        self.rich.print(line)


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
            _time_column(),
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
            text, total=total, completed=done, end=None, most="", note="", count=_count(done, total)
        )

    def move(
        self, kind: str, done: int | None, note: str, eta: float | None, text: str | None = None, most: str = ""
    ) -> None:
        """Move a bar to `done`; `most` stands before the time to go."""
        if kind not in self._tasks:
            return
        more: dict[str, Any] = {} if text is None else {"description": text}
        if done is not None:
            [total] = [task.total for task in self._progress.tasks if task.id == self._tasks[kind]]
            more["count"] = _count(done, total)
        from rich.markup import escape

        end = time.monotonic() + eta if eta else None
        self._progress.update(self._tasks[kind], completed=done, note=escape(note), end=end, most=most, **more)

    def note_room(self) -> int:
        """Columns beside spinner, description, bar, count and time to go, each as wide as its widest."""
        tasks = self._progress.tasks
        said = max(14, *(len(task.description) for task in tasks))
        count = max((len(_count(task.total, task.total)) for task in tasks), default=0)
        return self.width - (1 + said + self.bar + count + len(LONGEST) + 6)

    def close(self) -> None:
        self._progress.stop()


def _time_column() -> Any:
    """Make the column of a bar that counts the time to go down; without an end it shows the time since the start."""
    from rich.progress import ProgressColumn
    from rich.text import Text

    class Times(ProgressColumn):
        def render(self, task: Any) -> Text:
            left = -1.0 if task.fields["end"] is None else task.fields["end"] - time.monotonic()
            if left > 0:
                return Text(f"ETA {task.fields['most']}{duration(left)}")
            passed = task.elapsed or 0.0
            return Text(f"{duration(passed)} so far" if passed > HIDDEN else "")

    return Times()


def _count(done: float | None, total: float | None) -> str:
    return f"{done:.0f}/{total:.0f}" if total and done is not None else ""
