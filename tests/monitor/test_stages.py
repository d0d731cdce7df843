"""Progress without a terminal: a line when a stage begins, counts and the time to go while it lasts."""

import io

from bayessim_mjx.monitor.stages import EVERY, Lines


def test_lines_have_counts_and_the_time_to_go():
    clock, file = iter([0.0, 1.0, 2.0, 1.0 + EVERY, 5.0 + EVERY, 6.0 + EVERY, 7.0 + EVERY]), io.StringIO()
    say = Lines(file, lambda: next(clock))
    say("known parameters", 0, 1)
    say("pairs", 0, 21)  # at 2 s
    say("pairs", 6, 21)  # 9 s later: not yet
    say("pairs", 6, 21)  # 13 s after it began: 15 more take 32 s
    say("pairs", 9, 21)
    say("rivals", 0, 3)
    lines = file.getvalue().splitlines()
    assert lines == [
        "   1.0 s  known parameters",
        "   2.0 s  pairs: 0 of 21",
        "  15.0 s  pairs: 6 of 21, about 32 s left",
        "  17.0 s  rivals: 0 of 3",
    ]
