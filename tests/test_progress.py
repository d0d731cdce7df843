"""Progress: lines with counts and the time to go; shown where a person watches, and nowhere else unless asked for."""

import io
import sys
import threading
import time
import types

import pytest

from bayessim_mjx import progress
from bayessim_mjx.progress import BEAT, EVERY, Bars, Lines


class Terminal(io.StringIO):
    def isatty(self):
        return True


def notebook(monkeypatch, kernel):
    """IPython is imported; its shell has this kernel."""
    ipython = types.SimpleNamespace(get_ipython=lambda: types.SimpleNamespace(kernel=kernel))
    monkeypatch.setitem(sys.modules, "IPython", ipython)


def test_a_person_watches_a_terminal_or_a_notebook(monkeypatch):
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert not progress.watched()
    notebook(monkeypatch, None)  # IPython in a pipe
    assert not progress.watched()
    notebook(monkeypatch, "a kernel")
    assert progress.watched()
    monkeypatch.delitem(sys.modules, "IPython")
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert progress.watched()


@pytest.mark.parametrize(("wanted", "people", "shows"), [
    (None, False, False), (None, True, True), (False, True, False), (True, False, True),
])  # fmt: skip
def test_progress_is_shown_to_people_or_on_request(wanted, people, shows, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal() if people else io.StringIO())
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    with progress.shown(wanted) as show:
        show("training", 1, 2, "return -3")
        show.line("round 1/2: return -3")
    text = sys.stderr.getvalue()
    assert ("round 1/2: return -3" in text) is shows and bool(text) is shows


def test_a_function_is_called_in_its_place(capsys):
    calls = []
    with progress.shown(lambda *call: calls.append(call)) as show:
        show("training", 1, 2, "return -3")
        show.line("round 1/2")
    assert calls == [("training", 1, 2)] and capsys.readouterr() == ("", "")


def test_lines_have_counts_and_the_time_to_go():
    clock, file = iter([0.0, 1.0, 2.0, 1.0 + EVERY, 5.0 + EVERY, 6.0 + EVERY, 7.0 + EVERY]), io.StringIO()
    say = Lines(file, lambda: next(clock))
    say("known parameters", 0, 1)
    say("pairs", 0, 21)  # at 2 s
    say("pairs", 6, 21)  # 9 s later: not yet
    say("pairs", 6, 21)  # 4 s after that: 15 more take 22 s from then on
    say("pairs", 9, 21)
    say("rivals", 0, 3)
    lines = file.getvalue().splitlines()
    assert lines == [
        "   1.0 s  known parameters",
        "   2.0 s  pairs: 0 of 21",
        "  15.0 s  pairs: 6 of 21, about 18 s left",
        "  17.0 s  rivals: 0 of 3",
    ]


def test_the_time_to_go_runs_down_while_a_part_lasts_and_is_not_made_up_where_it_is_over():
    clock, file = iter([0.0, 0.0, 20.0, 30.0, 41.0, 60.0]), io.StringIO()
    say = Lines(file, lambda: next(clock))
    say("polishing", 0, 3)
    for done in (1, 1, 1, 2):
        say("polishing", done, 3)
    assert [line.strip() for line in file.getvalue().splitlines()[1:]] == [
        "20.0 s  polishing: 1 of 3, about 40 s left",
        "30.0 s  polishing: 1 of 3, about 30 s left",
        "41.0 s  polishing: 1 of 3, about 19 s left",
        "60.0 s  polishing: 2 of 3, about 30 s left",
    ]
    clock, file = iter([0.0, 0.0, 6.0, 20.0]), io.StringIO()
    say = Lines(file, lambda: next(clock))
    for done in (0, 1, 1):
        say("polishing", done, 2)
    assert file.getvalue().splitlines()[-1].endswith("polishing: 1 of 2")


def test_a_stage_without_counts_says_that_it_still_runs():
    """As compilation does, for minutes."""
    clock, file = iter([0.0, 1.0, 2.0, 1.0 + BEAT, 2.0 + BEAT, 1.0 + 2 * BEAT]), io.StringIO()
    say = Lines(file, lambda: next(clock))
    say("compiling the simulator", 0, 1)
    for _ in range(4):
        say.beat()
    assert file.getvalue().splitlines() == [
        "   1.0 s  compiling the simulator",
        "  31.0 s  compiling the simulator, 30 s so far",
        "  61.0 s  compiling the simulator, 1 min 00 s so far",
    ]


def test_the_beat_ends_with_its_block():
    calls = []
    with progress.beating(lambda: calls.append(threading.active_count())):
        time.sleep(1.3)
    assert len(calls) == 1 and calls[0] == threading.active_count() + 1


@pytest.mark.parametrize("width", [60, 80, 110])
def test_a_long_stage_leaves_room_for_its_bar(width, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm")
    with progress.stages(headless=False) as show:
        assert isinstance(show, Bars)
        show("a stage of many words " * 6, 1, 2)
        show.bars.refresh()
    text = sys.stderr.getvalue()
    assert "…" in text and "1/2" in text and "0:00:00" in text


def test_a_stage_that_has_ended_is_whole(monkeypatch):
    """Its last count was `64/67`, as counts come after batches."""
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    with progress.stages(headless=False) as show:
        show("compiling", 0, 1)
        show("screening", 64, 67)
        show("single effects", 0, 3)
        show("screening again", 0, 3)
        counts = {task.description: task.fields["count"] for task in show.bars.tasks}
        whole = [task.finished for task in show.bars.tasks]
    assert counts == {"compiling": "", "screening": "67/67", "single effects": "3/3", "screening again": "0/3"}
    assert whole == [True, True, True, False]


def test_stages_that_ended_long_ago_leave_the_terminal(monkeypatch):
    """A loop of many rounds has more parts than a terminal has lines: the one that runs would be cut off."""
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    with progress.stages(headless=False) as show:
        for part in range(40):
            show(f"part {part}", 0, 1)
        names = [task.description for task in show.bars.tasks]
    assert names == [f"part {k}" for k in range(40 - 1 - progress.ENDED, 40)]
