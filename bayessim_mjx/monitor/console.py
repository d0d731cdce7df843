"""What a run says on the terminal: progress bars with ETA where there is a terminal, plain lines everywhere else.

Takes plain numbers and dicts. Without a terminal (or with `headless`) no control character is ever written.
"""

import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TextIO

from bayessim_mjx.monitor.draws import shorten
from bayessim_mjx.monitor.words import ascii_of, duration, escape, fit, is_number, named, number, spoken, without_prefix

FILE_WIDTH = 140  # columns assumed where there is no terminal


class Clock:
    """Time to go, from the mean duration of the steps done here; compiling is not counted as a step's time."""

    def __init__(self, total: int, done: int = 0, now: Callable[[], float] = time.monotonic):
        self.total, self.done, self.now = total, done, now
        self.first, self.begun, self.excluded = done, now(), 0.0

    def exclude(self, seconds: float) -> None:
        self.excluded += seconds

    def advance(self, to: int | None = None) -> None:
        self.done = self.done + 1 if to is None else to

    def eta(self) -> float | None:
        """Seconds to go; None before the first step is done."""
        steps = self.done - self.first
        if steps <= 0:
            return None
        return max(self.now() - self.begun - self.excluded, 0.0) / steps * max(self.total - self.done, 0)


class Console:
    """Everything a command prints while it runs.

    with Console() as console:
        console.start({...}); console.begin(rounds=10)
        per round: console.phase("train", 200); console.iteration({...}) ...; console.round_line({...})
        console.table([...])

    Args:
        headless: plain lines even on a terminal.
        file: where to; None: standard output.
        now: clock in seconds.
    """

    def __init__(
        self, *, headless: bool = False, file: TextIO | None = None, now: Callable[[], float] = time.monotonic
    ):
        from rich.console import Console as RichConsole

        file = file or sys.stdout
        self.live = not headless and bool(getattr(file, "isatty", lambda: False)())
        options: dict[str, Any] = dict(file=file, highlight=False, soft_wrap=True)
        if not self.live:
            options |= dict(force_terminal=False, no_color=True, width=FILE_WIDTH)
        self._rich = RichConsole(**options)
        self._unicode = "utf" in (getattr(file, "encoding", None) or "utf-8").lower()
        self._now = now
        self._progress: Any = None
        self._rounds: Clock | None = None
        self._steps: Clock | None = None
        self._phase = ""
        self._bars: dict[str, Any] = {}
        self._showwarning = warnings.showwarning

    def __enter__(self) -> "Console":
        """While inside, warnings meant for the user (UserWarning) become lines here, not Python's own noise."""
        before = self._showwarning = warnings.showwarning

        def show(message: Any, category: Any, *where: Any, **more: Any) -> None:
            if issubclass(category, UserWarning):
                self.warning(str(message))
            else:
                before(message, category, *where, **more)

        warnings.showwarning = show
        return self

    def __exit__(self, *_: object) -> None:
        warnings.showwarning = self._showwarning
        self.close()

    @property
    def width(self) -> int:
        return self._rich.width if self.live else FILE_WIDTH

    # ---- what happens

    def start(self, summary: Mapping[str, Any]) -> None:
        """Say what is about to run: {what: value}, a list as one line, in the order given."""
        wide = max(map(len, summary), default=0)
        for key, value in summary.items():
            many = isinstance(value, Sequence) and not isinstance(value, str)
            text = fit([str(v) for v in value], 3 * (self.width - wide - 2)) if many else str(value)
            self._say(f"{key:<{wide}}  {text}", f"[bold]{key:<{wide}}[/]  ", text)

    def begin(self, rounds: int, done: int = 0) -> None:
        """Rounds to come, `done` of them finished before (resume)."""
        self._rounds = Clock(rounds, done, self._now)
        self._bar("round", f"round {min(done + 1, rounds)}/{rounds}", rounds, done)

    def phase(self, name: str, total: int | None = None, done: int = 0) -> None:
        """A part of the round begins (train, evaluate, simulate, fit ...), with `total` iterations if it has any."""
        self._phase = name
        self._steps = Clock(total, done, self._now) if total else None
        self._bar("phase", name, total, done)
        if not self.live:
            clock = self._rounds
            where = "" if clock is None else f"round {min(clock.done + 1, clock.total)}/{clock.total}: "
            self._say(f"{where}{name} ..." if not total else f"{where}{name}, {total - done} iterations ...")

    def compile(self, message: str, seconds: float, cached: bool = False) -> None:
        """A program was compiled; its time is kept out of the ETA. `cached`: it came from the compilation cache."""
        for clock in (self._rounds, self._steps):
            if clock is not None:
                clock.exclude(seconds)
        how = "loaded" if cached else "compiled"
        tail = "from the cache" if cached else "cached for the next start"
        self._say(f"{how} {message} in {duration(seconds)} ({tail})", "[dim]", None)

    def iteration(self, metrics: Mapping[str, Any], iteration: int | None = None) -> None:
        """One log interval of training: numbers in the order given, as many as fit.

        The bar moves to `iteration` of this phase (else to metrics["iteration"], else one on); `iteration`, `round` are
        not repeated among the numbers.
        """
        shown = {k: v for k, v in metrics.items() if k not in ("iteration", "round") and is_number(v)}
        numbers = [f"{spoken(k)} {number(v)}" for k, v in shown.items()]
        at = metrics.get("iteration") if iteration is None else iteration
        where, eta, done = self._phase or "iteration", None, None
        if self._steps is not None:
            self._steps.advance(None if at is None else int(at))
            eta, done = self._steps.eta(), self._steps.done
            where += f" {done}/{self._steps.total}"
        elif at is not None:
            where += f" {int(at)}"
        if self._progress is not None and "phase" in self._bars:
            self._move("phase", done, fit(numbers, max(self.width - 70, 20), "  ", count=False), eta)
            return
        ahead = f"  ETA {duration(eta)}" if eta else ""
        self._say(f"{where}  " + fit(numbers, self.width - len(where) - len(ahead) - 2, "  ", count=False) + ahead)

    def round_line(
        self,
        *,
        round: int,
        rounds: int | None = None,
        reward: tuple[float, float] | float | None = None,
        where: str = "real",
        gain: float | None = None,
        widths: Mapping[str, float] | None = None,
        seconds: float | None = None,
    ) -> None:
        """One line for a finished round; what is None is left out.

        Args:
            round: counted from 0. rounds: how many there are (default: what `begin` said).
            reward: mean (and standard deviation) of the return on the real system, or `where` it was measured.
            gain: log posterior - log prior at the truth [nats].
            widths: {parameter: posterior sd / prior sd}, in the order of interest: as many as fit are shown.
        """
        if self._rounds is not None:
            self._rounds.advance(int(round) + 1)
            rounds = rounds or self._rounds.total
        parts = [f"round {int(round) + 1}" + (f"/{rounds}" if rounds else "")]
        if reward is not None:
            values = reward if isinstance(reward, Sequence) else (reward,)
            parts.append(f"{where} reward " + " ± ".join(number(v) for v in values))
        if gain is not None and is_number(gain):
            parts.append(f"log p(truth) {float(gain):+.2f} nats vs prior")
        eta = self._rounds.eta() if self._rounds is not None else None
        tail = [] if seconds is None else [duration(float(seconds))]
        tail += [f"ETA {duration(eta)}"] if eta else []
        rows = 1 if self.width >= FILE_WIDTH else 2  # a narrow terminal breaks the line
        room = rows * self.width - len("   ".join(parts + tail)) - len("   sd/prior ")
        if widths:
            brief = without_prefix(list(widths))
            full, short = (fit(named(names, widths), room) for names in (brief, shorten(brief, 18)))
            fitting = short if "more" in full or not full else full
            parts += [f"sd/prior {fitting}"] if fitting else []
        self._say("   ".join(parts + tail), "[bold]", None)
        if self._rounds is not None:
            done, total = self._rounds.done, self._rounds.total
            self._move("round", done, "", eta, f"round {min(done + 1, total)}/{total}")

    def table(self, parameters: Sequence[Mapping[str, Any]], title: str = "parameters") -> None:
        """Closing table, best identified first, of {name, unit, low, high, mean, sd, truth or None, contraction}."""
        ordered = sorted(parameters, key=lambda row: -float(row.get("contraction") or 0.0))
        known = any(is_number(row.get("truth")) for row in ordered)
        rows = []
        for row in ordered:
            unit = f" [{row['unit']}]" if row.get("unit") else ""
            cells = [f"{row['name']}{unit}", f"{number(row['low'])} .. {number(row['high'])}"]
            cells.append(f"{number(row['mean'])} ± {number(row['sd'])}")
            cells += [number(row["truth"]) if is_number(row.get("truth")) else "-"] if known else []
            rows.append([*cells, f"{float(row['contraction']):.2f}" if is_number(row.get("contraction")) else "-"])
        self.grid(["parameter", "prior range", "posterior", *(["truth"] if known else []), "contraction"], rows, title)

    def grid(self, header: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> None:
        """A table of texts, the first column to the left, numbers to the right."""
        from rich import box
        from rich.table import Table

        style = box.SIMPLE_HEAD if self._unicode else box.ASCII
        table = Table(title=title, box=style, title_justify="left")
        for i, name in enumerate(header):
            table.add_column(escape(name), justify="right" if i else "left", overflow="fold")
        for row in rows:
            table.add_row(*[escape(self._plain(cell)) for cell in row])
        self._rich.print(table, soft_wrap=False)

    def say(self, text: str) -> None:
        """One plain line."""
        self._say(text)

    def warning(self, text: str) -> None:
        self._say(f"warning: {text}", "[yellow]", None)

    def close(self) -> None:
        """Take the progress bars away; a second call does nothing."""
        if self._progress is not None:
            self._progress.stop()
        self._progress, self._bars = None, {}

    # ---- how it is written

    def _plain(self, text: str) -> str:
        return text if self._unicode else ascii_of(text)

    def _say(self, text: str, style: str = "", rest: str | None = "") -> None:
        """Print one line; on a terminal `style` is markup in front (all of the line if `rest` is None)."""
        if not self.live or not style:
            self._rich.print(escape(self._plain(text)))
        elif rest is None:
            self._rich.print(f"{style}{escape(self._plain(text))}[/]")
        else:
            self._rich.print(style + escape(self._plain(rest)))

    def _bar(self, kind: str, text: str, total: int | None, done: int) -> None:
        if not self.live:
            return
        if self._progress is None:
            from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

            columns = (
                SpinnerColumn(),
                TextColumn("{task.description:<14}"),
                BarColumn(24),
                TextColumn("{task.fields[count]}"),
                TextColumn("{task.fields[eta]}"),
                TextColumn("{task.fields[note]}"),
            )
            self._progress = Progress(*columns, console=self._rich, transient=True)
            self._progress.start()
        if kind in self._bars:
            self._progress.remove_task(self._bars[kind])
        self._bars[kind] = self._progress.add_task(
            text, total=total, completed=done, eta="", note="", count=_count(done, total)
        )

    def _move(self, kind: str, done: int | None, note: str, eta: float | None, text: str | None = None) -> None:
        if self._progress is None or kind not in self._bars:
            return
        said = "" if eta is None else f"ETA {duration(eta)}"
        more: dict[str, Any] = {} if text is None else {"description": text}
        clock = self._rounds if kind == "round" else self._steps
        if clock is not None and done is not None:
            more["count"] = _count(done, clock.total)
        self._progress.update(self._bars[kind], completed=done, note=escape(note), eta=said, **more)


def _count(done: int, total: int | None) -> str:
    return f"{done}/{total}" if total else ""
