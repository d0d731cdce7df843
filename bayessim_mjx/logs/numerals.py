"""Numbers as people and spreadsheets write them: decimal commas, groups of thousands, and other signs and exponents."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_EXPONENT = r"(?:[eE][+-]?\d+)?"
_COMMA = re.compile(rf"[+-]?(?:\d*|\d{{1,3}}(?:\.\d{{3}})+),\d+{_EXPONENT}")
_COMMA_GROUPS = re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:,\d{{3}})+(?:\.\d*)?{_EXPONENT}")
_NUMERIC = re.compile(r"[+-]?[\d.,]*\d[\d.,]*(?:[eE][+-]?\d+)?")
_FORTRAN = re.compile(r"([+-]?\d*\.?\d+)[dD]([+-]?\d+)")
_HEXADECIMAL = re.compile(r"[+-]?0[xX][0-9a-fA-F]+")
# the minus sign of typography, and blanks that do not break
_SIGNS = str.maketrans({"\u2212": "-", "\u2013": "-", "\u00a0": " ", "\u202f": " ", "\u2009": " "})

BOTH = (
    'reads as a decimal comma or as groups of thousands; state `decimal: ","` or `thousands: ","` in a map '
    "(docs/logs.md)"
)
MIXED = (
    'stands beside numbers with decimal points or commas, so neither mark is sure; state `decimal: "."` or '
    '`decimal: ","`, and `thousands` for the other mark, in a map (docs/logs.md)'
)


@dataclass(frozen=True)
class Marks:
    """How the numbers of a file are written.

    Attributes:
        decimal: the mark before the fraction, "." or ",".
        thousands: the mark between groups of three digits, or None.
        doubt: what is wrong with fields that hold a comma, where the file shows two readings of them; else "".
        stated: whether a map says so: then the other mark is refused.
    """

    decimal: str = "."
    thousands: str | None = None
    doubt: str = ""
    stated: bool = False

    @property
    def plain(self) -> bool:
        """Whether numbers are written as programs write them."""
        return self.decimal == "." and self.thousands is None

    def number(self, text: str) -> float:
        """The number that a field holds.

        Raises:
            ValueError: none, or one that can be read in two ways.
        """
        text = text.translate(_SIGNS).strip()
        if self.thousands == " ":
            text = text.replace(" ", "")
        elif self.thousands is not None:
            text = self._joined(text, self.thousands)
        if self.decimal == ",":
            if "." in text:
                raise ValueError(f"a point where the decimal mark is a comma: {text}")
            text = text.replace(",", ".")
        if not text.isascii():
            raise ValueError(f"digits of another script: {text}")
        if _HEXADECIMAL.fullmatch(text):
            return float(int(text, 16))
        return float(_FORTRAN.sub(r"\1e\2", text) if _FORTRAN.fullmatch(text) else text)

    def _joined(self, text: str, mark: str) -> str:
        whole, decimal, rest = text.partition(self.decimal)
        groups = whole.lstrip("+-").split(mark)
        if len(groups) > 1 and not all(len(group) == 3 for group in groups[1:]):
            raise ValueError(f"no groups of three digits: {text}")
        return whole.replace(mark, "") + decimal + rest


def marks_of(rows: Sequence[Sequence[str]], decimal: str | None, thousands: str | None) -> Marks:
    """How the numbers among the fields of the rows are written; what the map states comes first.

    Without a key a decimal comma is taken only where no field can be read in another way.
    """
    if decimal is not None or thousands is not None:
        other = {",": ".", ".": ","}
        mark = decimal or other.get(thousands or "", ".")
        return Marks(mark, thousands, stated=True)
    held = (f.translate(_SIGNS).strip() for fields in rows for f in fields if "," in f)
    commas = [f for f in held if _NUMERIC.fullmatch(f)]
    if not commas:
        return Marks()
    pointed = (f.strip() for fields in rows for f in fields if "." in f and "," not in f)
    points = [f for f in pointed if _NUMERIC.fullmatch(f)]
    decimals = all(_COMMA.fullmatch(f) for f in commas)
    groups = all(_COMMA_GROUPS.fullmatch(f) for f in commas)
    if decimals and groups and not points:
        return Marks(doubt=BOTH)
    if decimals and not points:
        grouped = any("." in f for f in commas)
        return Marks(",", "." if grouped else None)
    if groups and not decimals:
        return Marks(".", ",")
    return Marks(doubt=BOTH if groups else MIXED)


__all__ = ["Marks", "marks_of"]
