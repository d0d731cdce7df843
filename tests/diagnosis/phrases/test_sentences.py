"""All sentences: as they were read and approved, in plain terms, each made by some result."""

import ast
import re
from pathlib import Path

import pytest

from bayessim_mjx.diagnosis.phrases import verdict
from tests.diagnosis.phrases import cases

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "bayessim_mjx"
SENTENCES = Path(__file__).with_name("sentences.txt")
# private senses of common words, and relative clauses in the place of a noun: the term of the field says it plainly
PRIVATE = re.compile(
    r"\b(told|tells? (?!MuJoCo)|asked|worth|looks?|comes? to|stands? beside|cannot tell)\b"
    r"|\bwhat (is|remains|was|it|they|no|this|the)\b|(?:^|[.:;] )(?:What|Whether|How much|How far) ",
)
OWN = ("diagnosis/phrases", "diagnosis/summary", "diagnosis/result.py", "report")
MOST_WORDS = 25
TITLE = "What would have been missed"  # of a blind check's section


def strings(path):
    """String literals of a file that are no docstrings; f-strings with {} in place of their values."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bare = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)}
    inside = {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in n.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in bare | inside:
            yield node.value
        if isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else "{}" for v in node.values)


def private(paths):
    return [(p.name, text) for p in paths for text in strings(p) if " " in text and PRIVATE.search(text)]


def files(*rooms):
    return sorted({f for room in rooms for f in [PACKAGE / room, *(PACKAGE / room).rglob("*.py")] if f.suffix == ".py"})


def own():
    return files(*OWN)


def test_sentences_are_those_that_were_approved():
    """A change is read in sentences.txt: `python -m tests.diagnosis.phrases.cases > tests/.../sentences.txt`."""
    assert cases.text() == SENTENCES.read_text(encoding="utf-8")


def test_sentences_use_no_private_terms():
    assert [line for line in cases.text().splitlines() if PRIVATE.search(line)] == []


def sentences(text):
    """Sentences as lists of words, without numbers and without brackets."""
    plain = re.sub(r"\([^()]*\)|\[[^\]]*\]", "", text)
    for sentence in re.split(r"(?<=[.])\s+", plain):
        yield [word for word in sentence.split() if re.search("[A-Za-z]", word)]


def test_no_sentence_is_longer_than_25_words():
    assert [" ".join(s) for line in cases.text().splitlines() for s in sentences(line) if len(s) > MOST_WORDS] == []


def test_no_sentence_that_the_room_of_words_can_make_has_a_private_term():
    assert private(own()) == []


def test_the_page_has_no_private_terms():
    page = (PACKAGE / "report" / "template.html.j2").read_text(encoding="utf-8").replace(TITLE, "")
    body = re.sub(r"\{[{%#].*?[}%#]\}", " ", page.partition("<body")[2].partition("<script>")[0], flags=re.S)
    assert [m[0] for text in re.findall(r">([^<]+)<", body) for m in PRIVATE.finditer(text.strip())] == []


def test_no_other_string_of_the_package_has_a_private_term():
    """Errors, warnings, help and tables of all rooms."""
    rest = [f for f in sorted(PACKAGE.rglob("*.py")) if f not in own()]
    assert len(rest) > 300 and private(rest) == []


@pytest.mark.parametrize("text", ["a remark is told here", "What remains is small", "it looks fine", "worth a word"])
def test_a_private_term_is_noticed(text):
    assert PRIVATE.search(text)


@pytest.mark.parametrize("text", ["the gap is closed", "see below where the force acts", "a knee, a hip"])
def test_a_plain_sentence_passes(text):
    assert not PRIVATE.search(text)


def templates():
    found = [v for k, v in vars(verdict).items() if k.isupper() and isinstance(v, str)]
    return [*found, *verdict.HEADS.values()]


@pytest.mark.parametrize("template", templates())
def test_every_template_is_made_by_some_result(template):
    pattern = ".+?".join(re.escape(part) for part in re.split(r"\{\w+\}", template.strip()))
    assert re.search(pattern, cases.text())


@pytest.mark.parametrize("name", cases.every())
def test_a_sentence_is_a_sentence(name):
    for text in cases.every()[name].sentences:
        assert text.endswith(".") and "{" not in text and "  " not in text and "nan" not in text
