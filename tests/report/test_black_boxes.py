"""Named effects stand beside black boxes on the page, in one sentence, and nowhere where they were not tried."""

import dataclasses

import pytest

from bayessim_mjx.diagnosis.phrases import residual
from bayessim_mjx.diagnosis.residual.black_boxes import BlackBoxes, Term
from bayessim_mjx.report import evidence
from tests.report import fake

TERMS = (Term("elbow", "sign w", -0.0613), Term("elbow", "1", 0.2), Term("wrist", "u of elbow", 0.5))


def test_the_table_has_shares_and_the_formula():
    d = fake.full()
    shown = evidence.black_boxes(d)
    assert [row["name"] for row in shown["rows"]] == ["the named effects", "a small network", "a sparse formula"]
    assert [row["share"] for row in shown["rows"]] == ["93 %", "87 %", "0 %"]  # worse than nothing is nothing
    assert shown["formula"] == ["hinge: -0.06 sign w"]
    assert evidence.black_boxes(dataclasses.replace(d, details={})) == {}


@pytest.mark.parametrize(
    ("named", "end"),
    [
        (0.931, ", a formula of 1 term nothing and the named effects 93 %."),
        (float("nan"), " and a formula of 1 term nothing."),
    ],
)
def test_one_sentence(named, end):
    (told,) = residual.black_boxes(BlackBoxes(0.874, -0.1, named, TERMS[:1], 4))
    head = "On held-out conditions a small network without physics closes 87 % of the squared gap"
    assert told == f"{head}{end}"
    assert residual.black_boxes(None) == []


def test_the_formula_in_words():
    words = residual.formula(BlackBoxes(0.0, 0.0, 0.0, TERMS, 4))
    assert words == ["elbow: -0.0613 sign w + 0.2", "wrist: 0.5 u of elbow"]
