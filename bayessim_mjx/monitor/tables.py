"""Text that fits a width without breaking a word: tables, paragraphs, and names of tags and parameters."""

import os
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

GAP = "  "  # between columns
TIE = "\u00a0"  # a space at which no line is broken
INDENT = 4  # of what belongs to the line above
# what a column of numbers is called on the terminal, where the tag's own last part is no plain word
SPOKEN = {
    "mean_reward": "reward",
    "mean_episode_length": "length",
    "total_fps": "steps/s",
    "learning_rate": "lr",
    "explained_variance": "explained",
    "value": "value loss",
    "mean_std": "action sd",
}


@dataclass(frozen=True)
class Layout:
    """Lines of a table: those of the header, then those of the rows."""

    header: list[str]
    rows: list[str]


def wrapped(text: str, width: int | None, indent: int = 0) -> list[str]:
    """`text` in lines of at most `width` characters, broken at spaces only; lines after the first are indented.

    A word longer than a line (a path, say) stays whole, and so do words joined by `TIE`, and a value with its
    uncertainty. None as width: one line.
    """
    if width is None or len(text) <= width:
        return [text.replace(TIE, " ")]
    lines = textwrap.wrap(
        _tied(text),
        max(width, 1),
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(TIE, " ") for line in lines] or [""]


def fit(parts: Sequence[str], room: int, joint: str = ", ", count: bool = True) -> str:
    """Join the first parts that fit, then how many more; nothing if not even one fits.

    Args:
        parts: texts, the most important first.
        room: characters.
        joint: what stands between them.
        count: say how many are left out.
    """
    for shown in range(len(parts), 0, -1):
        more = [f"+{len(parts) - shown} more"] if count and shown < len(parts) else []
        text = joint.join([*parts[:shown], *more])
        if len(text) <= room:
            return text
    return ""


def shell(command: str, width: int | None, indent: int = 0) -> list[str]:
    """Break a command into lines that can be pasted as they are: at spaces, with a backslash at the end."""
    before = " " * indent
    lines = wrapped(before + command, width and width - 2, indent + INDENT)
    return [f"{line} \\" for line in lines[:-1]] + lines[-1:]


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], width: int | None, left: Collection[int] = (0,)
) -> Layout:
    """Columns side by side; where that is too wide, the first column on a line of its own; else one value a line.

    Args:
        header, rows: texts [columns]; a header may be broken at its spaces, a cell only in the columns `left`.
        width: of the terminal; None: as wide as it comes.
        left: columns of words, aligned to the left; the others are numbers, aligned to the right.
    """
    if width is None or sum(least := _least(header, rows, left)) + len(GAP) * (len(header) - 1) <= width:
        return _columns(header, rows, width, left)
    others = {k - 1 for k in left if k}
    if len(header) > 2 and INDENT + sum(least[1:]) + len(GAP) * (len(header) - 2) <= width:
        rest = _blocks([header[1:], *(row[1:] for row in rows)], width - INDENT, others, names=False)
        blocks = [
            [*wrapped(row[0], width, INDENT), *(" " * INDENT + line for line in block)]
            for row, block in zip([header, *rows], rest, strict=True)
        ]
    else:
        blocks = [wrapped(header[0], width, INDENT), *(_record(header, row, width) for row in rows)]
    return Layout(blocks[0], [line for block in blocks[1:] for line in block])


def _record(header: Sequence[str], row: Sequence[str], width: int) -> list[str]:
    facts = [f"{' ' * INDENT}{name or '#'}: {cell}" for name, cell in zip(header[1:], row[1:], strict=True) if cell]
    return [*wrapped(row[0], width, INDENT), *(line for fact in facts for line in wrapped(fact, width, 2 * INDENT))]


def _columns(header: Sequence[str], rows: Sequence[Sequence[str]], width: int | None, left: Collection[int]) -> Layout:
    blocks = _blocks([header, *rows], width, left)
    return Layout(blocks[0], [line for block in blocks[1:] for line in block])


def _tied(text: str) -> str:
    return text.replace(" ± ", f"{TIE}±{TIE}").replace(" %", f"{TIE}%")


def _longest_word(text: str) -> int:
    return max(map(len, _tied(text).split(" ")), default=0)


def _least(header: Sequence[str], rows: Sequence[Sequence[str]], left: Collection[int]) -> list[int]:
    """Compute the width [columns] below which a word or a number would break."""
    return [
        max(_longest_word(name), *(_longest_word(row[k]) if k in left else len(row[k]) for row in rows), 0)
        for k, name in enumerate(header)
    ]


def _blocks(
    rows: Sequence[Sequence[str]], width: int | None, left: Collection[int], names: bool = True
) -> list[list[str]]:
    """Each row as lines; the first row is the header. `names`: the first column names the row, broken ones indented."""
    wide = _widths(rows, width, left)
    out = []
    for n, row in enumerate(rows):
        cells = []
        for k, (cell, w) in enumerate(zip(row, wide, strict=True)):
            after = 2 * (names and n > 0 and k == 0 and _longest_word(cell) + 2 <= w)
            cells.append(wrapped(cell, w if k in left or n == 0 else None, after))
        tall = max(map(len, cells))
        for k, broken in enumerate(cells):  # words begin at the top, a header stands on its column
            empty = [""] * (tall - len(broken))
            cells[k] = [*empty, *broken] if n == 0 else [*broken, *empty]
        lines = [
            GAP.join(c.ljust(w) if k in left else c.rjust(w) for k, (c, w) in enumerate(zip(line, wide, strict=True)))
            for line in zip(*cells, strict=True)
        ]
        out.append([line.rstrip() for line in lines])
    return out


def _widths(rows: Sequence[Sequence[str]], width: int | None, left: Collection[int]) -> list[int]:
    """As wide as the cells where there is room: first the headers are broken, then the columns of words."""
    natural = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    if width is None:
        return natural
    room = width - len(GAP) * (len(natural) - 1)
    least = _least(rows[0], rows[1:], left)
    cells = [max(_longest_word(rows[0][k]), *(len(row[k]) for row in rows[1:]), 0) for k in range(len(natural))]
    return _shrunk(natural, cells, room) if sum(cells) <= room else _shrunk(cells, least, room)


def _shrunk(wide: Sequence[int], least: Sequence[int], room: int) -> list[int]:
    """`wide` with the widest columns made narrower, none below `least`, until all fit into `room`."""
    wide = list(wide)
    while sum(wide) > room:
        can = [k for k in range(len(wide)) if wide[k] > least[k]]
        if not can:
            break
        wide[max(can, key=lambda k: wide[k])] -= 1
    return wide


def spoken(tag: str) -> str:
    """`Train/mean_reward` -> `reward`."""
    last = tag.rsplit("/", 1)[-1]
    return SPOKEN.get(last, last)


def named(names: Sequence[str], values: Mapping[str, float]) -> list[str]:
    """`mass 0.31` for every name and the value in its place."""
    return [f"{name} {float(value):.2g}" for name, value in zip(names, values.values(), strict=True)]


def without_prefix(names: Sequence[str]) -> list[str]:
    """Names without the words that all begin with: `pendulum_mass`, `pendulum_length` -> `mass`, `length`."""
    common = os.path.commonprefix(list(names)) if len(names) > 1 else ""
    cut = max(common.rfind("_"), common.rfind(".")) + 1
    return [name[cut:] for name in names]


def shorten(names: Sequence[str], width: int, lines: int = 1) -> list[str]:
    """Names in at most `lines` lines of `width` characters, broken after `_` and `.`, with … in the middle if too long.

    Names that would become the same are numbered.
    """
    short = [_fold(name, width, lines) for name in names]
    twice = {s for s in short if short.count(s) > 1}
    if not twice:
        return short
    folded = [_fold(name, width, lines, f"{i + 1}:") for i, name in enumerate(names)]
    return [folded[i] if s in twice else s for i, s in enumerate(short)]


def _fold(name: str, width: int, lines: int, number: str = "") -> str:
    """Choose the longest form that fits; one that breaks no word, where it keeps half as much at least."""
    most = min(len(name), width * lines - len(number))
    whole, broken = "", ""
    for keep in range(most, 1, -1):  # breaking wastes room at the line ends
        text = name if keep >= len(name) else name[: keep // 2] + "…" + name[len(name) - (keep - keep // 2 - 1) :]
        rows, clean = _rows(number + text, width)
        if len(rows) <= lines:
            broken = broken or "\n".join(rows)
            if clean:
                whole = "\n".join(rows)
                break
    return whole if 2 * len(whole) >= len(broken) > 0 else broken or (number + name)[:width]


def _rows(text: str, width: int) -> tuple[list[str], bool]:
    """Greedy lines of at most `width` characters, broken behind a separator where there is one; whether all were."""
    rows, clean = [], True
    while len(text) > width:
        cut = max((text.rfind(c, 0, width) for c in "_. …"), default=-1) + 1
        clean &= cut > 0
        cut = cut if cut > 0 else width
        rows.append(text[:cut])
        text = text[cut:]
    return [*rows, text] if text else rows, clean
