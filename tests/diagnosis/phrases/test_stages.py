"""Every stage that a diagnosis goes through has words for people."""

import re
from pathlib import Path

from bayessim_mjx import diagnosis
from bayessim_mjx.diagnosis.phrases.stages import WORDS, doing
from bayessim_mjx.diagnosis.run import STAGES
from bayessim_mjx.progress import Show, Silent, Worded

PLAIN = {"compiling the simulator", "fitting the known parameters"}  # are words already


def test_names_of_stages_in_the_code_have_words() -> None:
    files = [p for p in Path(diagnosis.__file__).parent.rglob("*.py") if p.parent.name in ("evidence", "selection")]
    named = {name for p in files for name in re.findall(r'\bsay\("([^"]+)"', p.read_text(encoding="utf-8"))}
    assert named - PLAIN <= WORDS.keys() and {s.name for s in STAGES} <= WORDS.keys() and len(named) > 4


def test_a_round_keeps_its_number_and_other_stages_their_name() -> None:
    assert doing("sets of effects, round 2") == "fitting several effects together, round 2"
    assert doing("checking the logs") == "checking the logs"


def test_progress_is_passed_on_in_words() -> None:
    heard = []

    class Ear(Silent):
        def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
            heard.append((stage, done, total, note))

        def line(self, text: str) -> None:
            heard.append(text)

    show = Worded(Ear(), doing)
    show("screening", 1, 2)
    show.line("a note")
    assert heard == [("trying every effect roughly", 1, 2, ""), "a note"] and isinstance(show, Show)
