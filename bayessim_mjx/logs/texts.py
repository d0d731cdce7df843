"""The bytes of a text file as lines: its encoding, and the first line by which a spreadsheet names its delimiter."""

from __future__ import annotations

import codecs
import re
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
_CANDIDATES = ("latin-1", "cp1250", "cp437", "shift_jis")
_NAMED = re.compile(r'"?sep=(.)"?\s*')


def lines_of(path: Path, encoding: str | None, allowed: str) -> list[str]:
    """The lines of a text file.

    UTF-8, and UTF-16 and UTF-32 with a byte order mark, need no key. A file whose only other bytes are the signs of
    units (the degree sign) is read as Latin-1.

    Args:
        encoding: as the map states it, or None.
        allowed: the tail of a refusal, what may be given instead.

    Raises:
        UserError: bytes that the encoding does not have, or that several encodings read differently.
    """
    raw = path.read_bytes()
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
    """The first line that is not UTF-8, as several encodings read it."""
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
    """The delimiter that a spreadsheet's first line `sep=;` names, or None."""
    match = _NAMED.fullmatch(line.lower())
    return match[1] if match else None


__all__ = ["lines_of", "named_delimiter"]
