"""Text files as lines of some encoding, and the numbers in them as people, spreadsheets and programs write them."""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bayessim_mjx.errors import UserError

_BOMS = (  # the longer first: that of UTF-32 begins with that of UTF-16
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# degree, square, cube, micro and middle dot have these bytes in Latin-1 and in the code pages of Windows that follow it
_SIGNS = frozenset(b"\xb0\xb2\xb3\xb5\xb7")
# first bytes of files that are no text: what they are, and the way on. Source: their formats
_OTHERS = {
    b"\x1f\x8b": "compressed by gzip: unpack it (gunzip)",
    b"PK\x03\x04": "a ZIP archive or a spreadsheet: unpack it, or export it as CSV",
    b"BZh91AY": "compressed by bzip2: unpack it",
    b"\xfd7zXZ": "compressed by xz: unpack it",
    b"\x28\xb5\x2f\xfd": "compressed by Zstandard: unpack it",
    b"\xd0\xcf\x11\xe0": "an old spreadsheet: export it as CSV",
    b"PAR1\x15": "a table of Parquet: write it as CSV (pandas: read_parquet, to_csv)",
    b"\x89HDF": "an HDF5 file: `logs from-hdf5` converts it",
    b"\x89MCAP": "an MCAP file: `logs from-mcap` converts it",
    b"#ROSBAG V": "a bag of ROS 1: `logs from-rosbag` converts it",
    b"MATLAB 5.0 MAT-file": "a MAT file: write it as CSV (writetable)",
}
_CANDIDATES = ("latin-1", "cp1250", "cp437", "shift_jis")
_NAMED = re.compile(r'"?sep=(.)"?\s*')


def lines_of(path: Path, encoding: str | None, allowed: str) -> list[str]:
    """Return the lines of a text file.

    UTF-8, and UTF-16 and UTF-32 with a byte order mark, need no key. A file whose only other bytes are the signs of
    units (the degree sign) is read as Latin-1.

    Args:
        encoding: as the map states it, or None.
        allowed: the tail of a refusal, what may be given instead.

    Raises:
        UserError: bytes that the encoding does not have, or that several encodings read differently.
    """
    raw = path.read_bytes()
    other = next((what for mark, what in _OTHERS.items() if raw.startswith(mark)), None)
    if other is not None:
        raise UserError(f"{path}: not a text file but {other}; {allowed}")
    if encoding is not None:
        return _decoded(path, raw, encoding, allowed).splitlines()
    for mark, name in _BOMS:
        if raw.startswith(mark):
            return _decoded(path, raw, name, allowed).splitlines()
    if b"\x00" in raw[:4096]:
        return _decoded(path, raw, _sixteen(raw), allowed).splitlines()
    try:
        return raw.decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        foreign = {byte for byte in raw if byte > 127}
        if foreign <= _SIGNS:
            return raw.decode("latin-1").splitlines()
        raise UserError(f"{path}: {_doubt(raw, error)}; {allowed}") from None


def _decoded(path: Path, raw: bytes, encoding: str, allowed: str) -> str:
    try:
        text = raw.decode(encoding)
        if any(char.isascii() and char.isprintable() for char in text[:4096]) and "\x00" not in text[:4096]:
            return text
        raise ValueError("no readable sign in it")
    except ValueError as error:
        mend = "`encoding` in a map names another, such as utf-8, utf-16, latin-1 or cp1252"
        raise UserError(f"{path}: not a text file in {encoding} ({error}); {mend}; {allowed}") from None


def _sixteen(raw: bytes) -> str:
    """Two bytes per sign without a mark: the byte that is 0 says which comes first."""
    head = raw[:4096]
    return "utf-16-le" if head[1::2].count(0) > head[0::2].count(0) else "utf-16-be"


def _doubt(raw: bytes, error: UnicodeDecodeError) -> str:
    """Return the first line that is not UTF-8, as several encodings read it."""
    start = raw.rfind(b"\n", 0, error.start) + 1
    line = raw[start : error.start + 12].split(b"\n")[0]
    readings: dict[str, str] = {}
    for name in _CANDIDATES:
        try:
            readings.setdefault(line.decode(name).strip()[-24:], name)
        except UnicodeDecodeError:
            continue
    number = raw.count(b"\n", 0, error.start) + 1
    shown = ", ".join(f"{text!r} by `encoding: {name}`" for text, name in readings.items())
    byte = f"byte 0x{raw[error.start]:02x} in line {number}"
    return f"not a text file in UTF-8 ({byte}); in a map one of these keys reads it: {shown}"


def named_delimiter(line: str) -> str | None:
    """Return the delimiter that a spreadsheet's first line `sep=;` names, or None."""
    match = _NAMED.fullmatch(line.lower())
    return match[1] if match else None


_EXPONENT = r"(?:[eE][+-]?\d+)?"
_COMMA = re.compile(rf"[+-]?(?:\d*|\d{{1,3}}(?:\.\d{{3}})+),\d+{_EXPONENT}")
_COMMA_GROUPS = re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:,\d{{3}})+(?:\.\d*)?{_EXPONENT}")
_NUMERIC = re.compile(r"[+-]?[\d.,]*\d[\d.,]*(?:[eE][+-]?\d+)?")
_FORTRAN = re.compile(r"([+-]?\d*\.?\d+)[dD]([+-]?\d+)")
_HEXADECIMAL = re.compile(r"[+-]?0[xX][0-9a-fA-F]+")
# the minus sign of typography, and blanks that do not break
_TYPOGRAPHY = str.maketrans({"\u2212": "-", "\u2013": "-", "\u00a0": " ", "\u202f": " ", "\u2009": " "})

BOTH = (
    'reads as a decimal comma or as groups of thousands; state `decimal: ","` or `thousands: ","` in a map '
    "(docs/logs.md)"
)
MIXED = (
    'appears beside numbers with decimal points or commas, so neither mark is sure; state `decimal: "."` or '
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
        """Return the number that a field holds.

        Raises:
            ValueError: none, or one that can be read in two ways.
        """
        text = text.translate(_TYPOGRAPHY).strip()
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
    held = (f.translate(_TYPOGRAPHY).strip() for fields in rows for f in fields if "," in f)
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


__all__ = ["Marks", "lines_of", "marks_of", "named_delimiter"]
