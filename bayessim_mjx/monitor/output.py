"""Lines, tables and frames on a terminal, or in a file that is to be searched."""

import os
from collections.abc import Collection, Sequence
from typing import Any, TextIO

from bayessim_mjx.monitor.tables import TIE, shell, table, wrapped
from bayessim_mjx.quantities import ascii_of

FILE_WIDTH = 140  # columns that tables and lists may take where there is no terminal
LEAST_WIDTH = 40  # narrower terminals break words


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
        self._blank = False

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
        if self.live and style:
            line.stylize(style, 0, styled)
        self.rich.print(line)
