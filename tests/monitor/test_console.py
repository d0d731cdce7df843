"""What is written without a terminal is plain text with the numbers in it; with one, bars that go away."""

import io
import re
import types
import warnings

import pytest

from bayessim_mjx.monitor.clock import Clock
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.monitor.tables import fit, without_prefix


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self):
        return True


def tell(file, **options):
    with Console(file=file, **options) as console:
        console.start({"task": "Pendulum", "parameters": ["mass [kg]", "length"], "run folder": "logs/x"})
        console.begin(3)
        console.phase("train", 20)
        console.compile("PPO update", 7.34)
        console.iteration({"Train/mean_reward": -455.25, "fps": 123456.0, "kl": float("nan"), "iteration": 10})
        console.phase("fit")
        console.round_line(
            round=0, reward=(-455.2, 31.0), gain=2.31, widths={"mass": 0.12, "length": 0.4}, seconds=42.0
        )
        console.round_line(round=1, reward=-400.0, gain=None)
        console.warning("no video [egl]")
        rows = [
            dict(name="length", low=0.01, high=2, median=0.5, q16=0.25, q84=0.75, sd=0.25, truth=None, width=0.95),
            dict(
                name="mass", unit="kg", low=0.01, high=2, median=1.02, q16=0.92, q84=1.12, sd=0.1, truth=1.0, width=0.17
            ),
        ]
        console.table(rows)
    return file.getvalue()


def test_plain_output_has_the_numbers_and_no_control_characters():
    text = tell(io.StringIO())
    assert not set(text) & {"\x1b", "\r", "\b"}
    lines = [line.rstrip() for line in text.splitlines()]
    assert lines[1] == "parameters  mass [kg], length"
    assert "compiled PPO update in 7.3 s (cached for the next start)" in lines
    assert any(line.startswith("train 10/20  reward -455.2  fps 123.5k") for line in lines)
    first = next(line for line in lines if line.startswith("round 1/3 "))
    assert first.startswith(
        "round 1/3   real return -455 ± 31   log density at the truth +2.31 nats over the prior   "
        "posterior/prior sd mass 0.12, length 0.4   42 s"
    )
    assert next(line for line in lines if line.startswith("round 2/3 ")).startswith("round 2/3   real return -400")
    assert "warning: no video [egl]" in lines
    mass, length = (next(i for i, x in enumerate(lines) if n in x and " to " in x) for n in ("mass [kg]", "length"))
    assert mass < length and "1.02 ± 0.10" in lines[mass] and "0.17" in lines[mass]


def test_headless_is_plain_on_a_terminal_too():
    assert "\x1b" not in tell(Terminal(), headless=True)


def test_a_terminal_gets_bars_and_the_same_lines():
    text = tell(Terminal())
    assert "\x1b" in text and "real return -455 ± 31" in text and "━" in text


def test_ascii_streams_get_ascii():
    file = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
    file.getvalue = lambda: file.buffer.getvalue().decode("ascii")
    text = tell(file)
    assert "-455 +/- 31" in text and "parameters  mass [kg], length" in text


def test_many_widths_are_cut_to_a_line():
    file = io.StringIO()
    widths = {f"left_front_leg_{i}_mass_mult": 0.1 for i in range(40)}
    Console(file=file).round_line(round=0, reward=(1.0, 2.0), widths=widths)
    [line] = file.getvalue().splitlines()
    assert "more" in line and len(line) <= 200


WORDS = (
    "warning: not identified by these trajectories, kept at the prior: left_front_leg_stiffness_mult, "
    "right_back_foot_mass_mult and the others of a long list of names"
)


@pytest.mark.parametrize("width", [80, 140])
def test_no_word_is_broken_at_the_terminals_width(monkeypatch, width):
    """Every line fits, and every word of what was said stands whole in some line."""
    monkeypatch.setenv("COLUMNS", str(width))
    names = ["left_front_leg_stiffness_mult", "index_finger_proximal_abduction_joint_friction_loss", "torso_mass_mult"]
    for file in (io.StringIO(), Terminal()):
        console = Console(file=file)
        console.start({"parameters": [f"{name} 0.5 to 1.5" for name in names * 9], "note": WORDS})
        console.say(WORDS)
        console.round_line(round=3, rounds=10, reward=(-1.0, 2.0), gain=1.0, widths=dict.fromkeys(names, 0.5))
        numbers = dict(median=1.04, q16=0.976, q84=1.104, sd=0.064, truth=1.0, width=0.3)
        rows = [dict(name=n, unit="N m", low=0, high=2, **numbers) for n in names]
        console.table(rows)
        console.grid(["effect", "where", "gap closed"], [[WORDS, "left hind knee", "12.3 ± 1.2"]], left=(0, 1))
        console.panel("Unexplained", [(WORDS, "bold")], "red")
        lines = re.sub(r"\x1b\[[0-9;]*m", "", file.getvalue()).splitlines()
        assert max(map(len, lines)) <= width
        said = {word.strip(",│") for line in lines for word in line.split()}
        assert {word.strip(",") for word in WORDS.split()} <= said and {*names} <= said
        assert all(any(whole in line for line in lines) for whole in ("1.040 ± 0.064", "12.3 ± 1.2"))


def test_a_command_can_be_pasted_at_every_width(monkeypatch):
    command = "python -m bayessim_mjx.play --checkpoint logs/Pendulum/2026-11-22_18-59-13_a_long_name --video"
    for width in (60, 140):
        monkeypatch.setenv("COLUMNS", str(width))
        file = io.StringIO()
        Console(file=file).command("best policy", command)
        head, *lines = file.getvalue().splitlines()
        assert head == "best policy:" and max(map(len, lines)) <= width
        joined = "\n".join(lines).replace("\\\n", "")  # as a shell reads it
        assert joined.split() == command.split()


def test_without_a_terminal_what_is_said_is_one_line(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    file = io.StringIO()
    Console(file=file).say(3 * WORDS)
    assert file.getvalue().splitlines() == [3 * WORDS]


def test_compiling_does_not_count_as_a_steps_time():
    now = [0.0]
    clock = Clock(10, now=lambda: now[0])
    assert clock.eta() is None
    now[0] = 22.0
    clock.exclude(20.0)
    clock.advance()
    assert clock.eta() == 2.0 * 9
    now[0] = 24.0
    clock.advance(2)
    assert clock.eta() == 2.0 * 8


def test_a_resumed_run_counts_only_its_own_rounds():
    now = [0.0]
    clock = Clock(10, done=6, now=lambda: now[0])
    now[0] = 5.0
    clock.advance()
    assert clock.eta() == 15.0


def test_lists_and_names_are_short():
    assert fit(["aa", "bb", "cc"], 100) == "aa, bb, cc"
    assert fit(["aaaa", "bbbb", "cccc"], 14) == "aaaa, +2 more"
    assert fit(["aaaa"], 2) == ""
    assert fit(["aaaa", "bbbb"], 5, count=False) == "aaaa"
    assert without_prefix(["rod_mass", "rod_length"]) == ["mass", "length"]
    assert without_prefix(["rod_mass"]) == ["rod_mass"]


def test_warnings_for_the_user_are_lines_and_others_keep_their_way():
    file, before, elsewhere = io.StringIO(), warnings.showwarning, []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_, **__: elsewhere.append(str(message))
        with Console(file=file):
            warnings.warn("a.csv: time repeats", stacklevel=1)
            warnings.warn("old", DeprecationWarning, stacklevel=1)
    assert file.getvalue() == "warning: a.csv: time repeats\n" and elsewhere == ["old"]
    assert warnings.showwarning is before


def test_compile_time_of_a_program_inside_another_counts_once():
    from bayessim_mjx.monitor.clock import BACKEND, COMPILE, RETRIEVED, CompileClock

    now = [0.0]
    clock = CompileClock(lambda: now[0])
    for at, event, seconds in ((2.0, "trace", 1.0), (5.0, "trace", 4.5), (9.0, "backend_compile_duration", 3.0)):
        now[0] = at
        clock._duration(COMPILE + event, seconds)
    assert clock.take() == (7.5, False)
    clock._duration(RETRIEVED, 0.2)
    clock._duration(BACKEND, 0.3)
    assert clock.take()[1] and clock.take() == (0, False)


def test_a_part_without_lines_says_that_it_still_runs():
    """After 30 s, and then ever more seldom; any other line begins the wait anew."""
    now, file = [0.0], io.StringIO()
    console = Console(file=file, now=lambda: now[0])
    console.begin(5, at_most=True)
    console.phase("fitting the network")
    for _ in range(100):
        now[0] += 1.0
        console._beat()
    where = "round 1/5: fitting the network"
    assert file.getvalue().splitlines() == [f"{where} ...", f"{where}, 31 s so far", f"{where}, 1 min 01 s so far"]
    console.say("a line")
    for _ in range(30):
        now[0] += 1.0
        console._beat()
    assert file.getvalue().splitlines()[3:] == ["a line"]
    console.round_line(round=0)
    assert "ETA at most 8 min 40 s" in file.getvalue()
    console.round_line(round=1, ends=True)
    assert file.getvalue().splitlines()[-1] == "round 2/5"


def test_a_bar_counts_the_time_to_go_down_and_shows_the_time_so_far_without_one(monkeypatch):
    from bayessim_mjx.monitor import output

    now, task = [100.0], types.SimpleNamespace(elapsed=1.0, fields={"end": None, "most": "at most "})
    monkeypatch.setattr(output.time, "monotonic", lambda: now[0])
    column = output._time_column()
    assert column.render(task).plain == ""
    task.elapsed = 65.0
    assert column.render(task).plain == "1 min 05 s so far"
    task.fields["end"] = 190.0
    assert column.render(task).plain == "ETA at most 1 min 30 s"
    now[0] = 191.0
    assert column.render(task).plain == "1 min 05 s so far"
