"""Tables lie as they were laid out by hand."""

from bayessim_mjx.monitor.tables import TIE, shell, table, wrapped

HEADER = ["effect", "parameters", "gap closed"]
ROWS = [["Coulomb friction", "level 0.03 ± 0.01", "68 %"], ["Command delay", "", "7 %"]]


def lines(width, left=(0, 1)):
    laid = table(HEADER, ROWS, width, left)
    return laid.header + laid.rows


def test_as_wide_as_it_comes():
    assert lines(None) == [
        "effect            parameters         gap closed",
        "Coulomb friction  level 0.03 ± 0.01        68 %",
        "Command delay                               7 %",
    ]


def test_headers_are_broken_first():
    assert lines(43) == [
        "                                        gap",
        "effect            parameters         closed",
        "Coulomb friction  level 0.03 ± 0.01    68 %",
        "Command delay                           7 %",
    ]


def test_then_words_and_never_a_value_from_its_uncertainty():
    """32 columns less two gaps and the 6 of `closed` leave 11 for each of the others."""
    assert lines(32) == [
        "                             gap",
        "effect       parameters   closed",
        "Coulomb      level          68 %",
        "  friction   0.03 ± 0.01",
        "Command                      7 %",
        "  delay",
    ]


def test_then_the_first_column_stands_above_the_others():
    assert lines(26) == [
        "effect",
        "                       gap",
        "    parameters      closed",
        "Coulomb friction",
        "    level             68 %",
        "    0.03 ± 0.01",
        "Command delay",
        "                       7 %",
    ]


def test_at_last_one_value_a_line():
    assert lines(20) == [
        "effect",
        "Coulomb friction",
        "    parameters:",
        "        level",
        "        0.03 ± 0.01",
        "    gap closed: 68 %",
        "Command delay",
        "    gap closed: 7 %",
    ]


def test_paragraphs():
    assert wrapped("one two three", 8, 2) == ["one two", "  three"]
    assert wrapped(f"one two{TIE}three", 10) == ["one", "two three"]
    assert wrapped("a/very/long-path/indeed x", 8) == ["a/very/long-path/indeed", "x"]
    assert wrapped("one two three", None) == ["one two three"]


def test_a_command_goes_on_behind_a_backslash():
    assert shell("python -m x --video", 14, 2) == ["  python -m \\", "      x \\", "      --video"]
