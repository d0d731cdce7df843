"""What a person reads first has sentences of at most 25 words: README, first pages, help, report."""

import contextlib
import io
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from bayessim_mjx import main
from tests.test_docs import COMMANDS, FORMATS

ROOT = Path(__file__).parents[1]
MOST = 25  # words, so that a sentence is read once; plain-language guides say 15 to 25
PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("index", "choosing", "first_run", "troubleshooting", "own_robot")),
)
REPORT = ROOT / "tests/diagnosis/phrases/sentences.txt"


def sentences(text: str) -> Iterator[str]:
    """Sentences of Markdown's paragraphs, items and cells; code and links' addresses are no words."""
    text = re.sub(r"```.*?```|<[^>]*>|\$\$.*?\$\$", "", text, flags=re.S)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*|#>]|\d+\.) ?)|\|", text):
        yield from re.split(r"(?<=[.!?:;])\s+", " ".join(block.split()))


def words(sentence: str) -> int:
    """Words of a sentence; a span of code is one, a number with its unit and error is one."""
    plain = re.sub(r"`[^`]*`", "code", sentence)
    plain = re.sub(r"\([^)]*\d[^)]*\)", "", plain)  # numbers in brackets are beside the sentence
    return len(re.findall(r"[^\W\d_][\w'’-]*", plain))


def long(text: str) -> list[str]:
    return [s for s in sentences(text) if words(s) > MOST]


@pytest.mark.parametrize("page", PAGES)
def test_first_pages_have_short_sentences(page: str):
    assert long((ROOT / page).read_text(encoding="utf-8")) == []


def test_the_report_has_short_sentences():
    assert long(REPORT.read_text(encoding="utf-8").replace("\n", "\n\n")) == []


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_short_sentences(command: str):
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        for first in FORMATS if command == "logs" else ("",):
            main.main([command.replace("_", "-"), *filter(None, [first]), "--help"])
    entries = re.sub(r"\n {2,}(?=-|\w[\w-]*\n)", "\n\n", text.getvalue())
    assert long(re.sub(r"\n {2}(?=\S)", "\n\n", entries)) == []


def test_long_sentences_are_seen():
    assert long("One. " + "word " * 26 + "\n\n- short\n") and not long("word " * 25 + ". `a b c d` " + "word " * 24)
