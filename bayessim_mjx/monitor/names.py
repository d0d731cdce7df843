"""Tags and parameters by names that fit: as plain words, without what all begin with, shortened."""

import os
from collections.abc import Mapping, Sequence

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
