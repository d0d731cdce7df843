"""What a run says on the terminal: progress bars with ETA where there is a terminal, plain lines everywhere else.

Takes plain numbers and dicts. Without a terminal (or with `headless`) no control character is ever written. Lines are
broken at spaces, at the terminal's width or $COLUMNS; without either, what is said is one line, so that logs can be
searched.
"""

from __future__ import annotations

import contextlib
import sys
import time
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TextIO

from bayessim_mjx.monitor.clock import Clock
from bayessim_mjx.monitor.output import Bars, Output
from bayessim_mjx.monitor.tables import TIE, fit, named, shorten, spoken, without_prefix
from bayessim_mjx.progress import BEAT, beating
from bayessim_mjx.quantities import compact, duration, estimate, is_number, spread

WIDTHS = "posterior/prior sd"


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
        self._out, self._now = Output(headless, file or sys.stdout), now
        self._bars: Bars | None = None
        self._rounds: Clock | None = None
        self._steps: Clock | None = None
        self._phase, self._begun, self._most = "", 0.0, ""
        self._quiet, self._wait, self._written = 0.0, BEAT, 0  # since when nothing was printed, how long that may last
        self._beating = contextlib.ExitStack()
        self._showwarning = warnings.showwarning

    def __enter__(self) -> Console:
        """While inside, warnings meant for the user (UserWarning) become lines here, not Python's own noise."""
        before = self._showwarning = warnings.showwarning

        def show(message: Any, category: Any, *where: Any, **more: Any) -> None:
            if issubclass(category, UserWarning):
                self.warning(str(message))
            else:
                before(message, category, *where, **more)

        warnings.showwarning = show
        if not self.live:
            self._beating.enter_context(beating(self._beat))
        return self

    def __exit__(self, *_: object) -> None:
        warnings.showwarning = self._showwarning
        self._beating.close()
        self.close()

    @property
    def live(self) -> bool:
        """Whether there is a terminal to draw on."""
        return self._out.live

    @property
    def width(self) -> int:
        """Columns."""
        return self._out.width

    # ---- what happens

    def start(self, summary: Mapping[str, Any]) -> None:
        """Say what is about to run: {what: value}, a list as one line, in the order given."""
        wide = max(map(len, summary), default=0)
        for key, value in summary.items():
            many = isinstance(value, Sequence) and not isinstance(value, str)
            # an entry of a list is not torn apart
            items = [str(v).replace(" ", TIE) for v in value] if many else []
            text = fit(items, 3 * (self.width - wide - 2)) if many else str(value)
            first, *more = self._out.broken(f"{key:<{wide}}  {text}", wide + 2)
            self._out.line(first, "bold", len(key))
            for line in more:
                self._out.line(line)

    def begin(self, rounds: int, done: int = 0, at_most: bool = False) -> None:
        """Announce rounds to come, `done` of them finished before (resume); `at_most`: they may end sooner."""
        self._most = "at most " if at_most else ""
        self._rounds = Clock(rounds, done, self._now)
        self._bar("round", f"round {min(done + 1, rounds)}/{rounds}", rounds, done)

    def phase(self, name: str, total: int | None = None, done: int = 0) -> None:
        """Begin a part of the round (train, evaluate, simulate, fit ...), with `total` iterations if it has any."""
        self._phase, self._begun = name, self._now()
        self._steps = Clock(total, done, self._now) if total else None
        self._bar("phase", name, total, done)
        if not self.live:
            what = self._where() + name
            self._out.say(f"{what} ..." if not total else f"{what}, {total - done} iterations ...")

    def _where(self) -> str:
        """Name the round that runs, where there are rounds."""
        clock = self._rounds
        return "" if clock is None else f"round {min(clock.done + 1, clock.total)}/{clock.total}: "

    def _beat(self) -> None:
        """Print that a part still runs after BEAT s without a line, then after twice as long, and so on."""
        now = self._now()
        if self._written != self._out.written:
            self._quiet, self._wait, self._written = now, BEAT, self._out.written
        elif self._phase and now - self._quiet >= self._wait:
            self._wait *= 2
            self._out.say(f"{self._where()}{self._phase}, {duration(now - self._begun)} so far")
            self._written = self._out.written

    def compile(self, message: str, seconds: float, cached: bool = False) -> None:
        """Keep the time of a compilation out of the ETA. `cached`: the program came from the compilation cache."""
        for clock in (self._rounds, self._steps):
            if clock is not None:
                clock.exclude(seconds)
        how = "loaded" if cached else "compiled"
        tail = "from the cache" if cached else "cached for the next start"
        self._out.say(f"{how} {message} in {duration(seconds)} ({tail})", "dim")

    def iteration(self, metrics: Mapping[str, Any], iteration: int | None = None) -> None:
        """One log interval of training: numbers in the order given, as many as fit.

        The bar moves to `iteration` of this phase (else to metrics["iteration"], else one on); `iteration`, `round` are
        not repeated among the numbers.
        """
        shown = {k: v for k, v in metrics.items() if k not in ("iteration", "round") and is_number(v)}
        numbers = [f"{spoken(k)} {compact(v)}" for k, v in shown.items()]
        at = metrics.get("iteration") if iteration is None else iteration
        where, eta, done = self._phase or "iteration", None, None
        if self._steps is not None:
            self._steps.advance(None if at is None else int(at))
            eta, done = self._steps.eta(), self._steps.done
            where += f" {done}/{self._steps.total}"
        elif at is not None:
            where += f" {int(at)}"
        if self._bars is not None and "phase" in self._bars:
            self._bars.move("phase", done, fit(numbers, self._bars.note_room(), "  ", count=False), eta)
            if self._steps is not None and self._steps.done >= self._steps.total:  # the bar goes: its numbers stay
                self._out.facts([where, *numbers], "")
            return
        ahead = f"  ETA {duration(eta)}" if eta else ""
        self._out.say(f"{where}  " + fit(numbers, self.width - len(where) - len(ahead) - 2, "  ", count=False) + ahead)

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
        ends: bool = False,
    ) -> None:
        """One line for a finished round; what is None is left out.

        Args:
            round: counted from 0. rounds: how many there are (default: what `begin` said).
            reward: mean (and standard deviation) of the return on the real system, or `where` it was measured.
            gain: log posterior - log prior at the truth [nats].
            widths: {parameter: posterior sd / prior sd}, in the order of interest: as many as fit are shown.
            ends: whether no further round follows.
        """
        if self._rounds is not None:
            self._rounds.advance(int(round) + 1)
            rounds = rounds or self._rounds.total
        parts = [f"round {int(round) + 1}" + (f"/{rounds}" if rounds else "")]
        if reward is not None:
            parts.append(f"{where} return {estimate(*reward) if isinstance(reward, Sequence) else compact(reward)}")
        if gain is not None and is_number(gain):
            parts.append(f"log density at the truth {float(gain):+.2f} nats over the prior")
        eta = self._rounds.eta() if self._rounds is not None and not ends else None
        tail = [] if seconds is None else [duration(float(seconds))]
        tail += [f"ETA {self._most}{duration(eta)}"] if eta else []
        if widths:
            room = self.width - len(f"    {WIDTHS} ")
            brief = without_prefix(list(widths))
            fitting = fit(named(brief, widths), room) or fit(named(shorten(brief, 18), widths), room)
            parts += [f"{WIDTHS} {fitting}"] if fitting else []
        self._out.facts(parts + tail, "bold")
        if self._rounds is not None and self._bars is not None:
            done, total = self._rounds.done, self._rounds.total
            self._bars.move("round", done, "", eta, f"round {min(done + 1, total)}/{total}", self._most)

    def table(self, parameters: Sequence[Mapping[str, Any]], title: str = "parameters", beside: str = "") -> None:
        """Print the closing table, best identified first: {name, unit, low, high, median, q16, q84, sd, width, truth}.

        Args:
            parameters: q16 to q84 is the 68 % interval, width the posterior's sd over the prior's; truth may be None.
            title: of the table.
            beside: what else belongs to the posterior, for the line below.
        """
        ordered = sorted(parameters, key=lambda row: float(row["width"]))
        known = any(is_number(row.get("truth")) for row in ordered)
        rows = []
        for row in ordered:
            unit = f" [{row['unit']}]" if row.get("unit") else ""
            cells = [f"{row['name']}{unit}", f"{compact(row['low'])} to {compact(row['high'])}"]
            cells.append(spread(row["median"], row["q16"], row["q84"], row["sd"]))
            cells += [compact(row["truth"]) if is_number(row.get("truth")) else "-"] if known else []
            rows.append([*cells, f"{float(row['width']):.2g}"])
        self.grid(["parameter", "prior range", "median, 68 %", *(["truth"] if known else []), WIDTHS], rows, title)
        if beside:
            self.say(beside)

    def grid(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[str]],
        title: str | None = None,
        left: Collection[int] = (0,),
    ) -> None:
        """Print a table of texts: the columns `left` hold words, the others numbers. See `tables.table`."""
        self._out.grid(header, rows, title, left)

    def panel(self, title: str, lines: Sequence[tuple[str, str]], colour: str) -> None:
        """Print a frame of `colour` round lines of (text, style), with a title."""
        self._out.panel(title, lines, colour)

    def say(self, text: str, indent: int = 4) -> None:
        """One plain line, or a paragraph whose later lines are indented."""
        self._out.say(text, indent=indent)

    def command(self, what: str, command: str) -> None:
        """Print a command that the user may want to paste, on lines of its own: it stays whole, whatever the width."""
        self._out.command(what, command)

    def warning(self, text: str) -> None:
        self._out.say(f"warning: {text}", "yellow")

    def close(self) -> None:
        """Take the progress bars away; a second call does nothing."""
        if self._bars is not None:
            self._bars.close()
        self._bars = None

    def _bar(self, kind: str, text: str, total: int | None, done: int) -> None:
        if self.live:
            self._bars = self._bars or Bars(self._out.rich, self.width)
            self._bars.show(kind, text, total, done)
