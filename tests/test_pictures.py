"""Pictures in docs/pictures are not older than the words."""

import html
import re
from pathlib import Path

from bayessim_mjx import config, registry
from bayessim_mjx.diagnosis.phrases import verdict
from bayessim_mjx.monitor.opening import opening

ROOT = Path(__file__).parents[1]
# in the places of templates: numbers, names, forms of words
FILLED = re.compile(
    r"\d[\d.]* ?%?|[,:;.()±]|\bhinge\b|\bthe effects\b|\bconditions?\b|\bOn held-out\b|\bin turn\b"
    r"|Chosen and fitted|less than one in a million|for the known parameters alone"
)


def lines_of(picture: str) -> list[str]:
    """Lines of a terminal's picture; one that goes on, indented, in the next is one."""
    text = (ROOT / "docs" / "pictures" / picture).read_text(encoding="utf-8")
    rows: dict[float, list[tuple[float, str]]] = {}
    for x, y, words in re.findall(r'<text[^>]* x="([\d.]+)" y="([\d.]+)"[^>]*>([^<]*)</text>', text):
        rows.setdefault(float(y), []).append((float(x), html.unescape(words).replace("\xa0", " ")))
    found: list[str] = []
    for y in sorted(rows):
        line = "".join(words for _, words in sorted(rows[y])).rstrip()
        if found and line.startswith("    "):
            found[-1] += f" {line.strip()}"
        else:
            found.append(line)
    return found


def test_pictures_of_the_terminal_are_of_the_commands_and_words_of_today():
    """Made by docs/make_pictures.py: after a change of words they are made anew."""
    first = re.search(r"-m bayessim_mjx\.(main --task \w+)", (ROOT / "README.md").read_text())
    loop = lines_of("loop.svg")
    assert first is not None and f"bayessim-mjx {first[1]}" in loop
    settings = config.load("Pendulum")
    lines = opening(settings, registry.make("Pendulum", config=settings), "cpu:0")
    texts = {key: ", ".join(text) if isinstance(text, list) else str(text) for key, text in lines.items()}
    begins = [f"{key:<10}  {text}" for key, text in texts.items() if key not in ("device", "note")]
    assert len(begins) > 5 and [line for line in begins if line not in loop] == []
    rows = re.findall(r"^\| `(posterior: refined[^`]*)`", (ROOT / "docs" / "first_run.md").read_text(), re.M)
    (refined,) = (re.compile(re.sub(r"\d+", r"\\d+", row)) for row in rows)
    assert any(refined.fullmatch(line) for line in loop) and any(line.startswith("settled: ") for line in loop)
    said = " ".join(line.removeprefix("- ") for line in lines_of("diagnosis.svg") if line.startswith("- "))
    every = " ".join([*(v for k, v in vars(verdict).items() if k.isupper() and isinstance(v, str))])
    parts = [part.strip() for part in FILLED.split(said)]
    long = [
        part
        for part in parts
        if len(part) > 20 and "network" not in part and "named effects" not in part and "noise sd" not in part
    ]
    assert len(long) > 6 and [part for part in long if part not in every] == []
