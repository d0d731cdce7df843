"""Numbers, durations and names as short words for the terminal."""

import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

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

_PLAIN = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def spoken(tag: str) -> str:
    """`Train/mean_reward` -> `reward`."""
    last = tag.rsplit("/", 1)[-1]
    return SPOKEN.get(last, last)


def is_number(value: Any) -> bool:
    try:
        return value is not None and not isinstance(value, str) and not math.isnan(float(value))
    except (TypeError, ValueError):
        return False


def number(value: Any) -> str:
    """Four significant digits, whole numbers as such, large ones with k and M."""
    x = float(value)
    if abs(x) >= 1e6 and math.isfinite(x):
        return f"{x / 1e6:.4g}M"
    if abs(x) >= 1e4 and math.isfinite(x):
        return f"{x / 1e3:.4g}k"
    return f"{x:.4g}"


def duration(seconds: float | None) -> str:
    """`3.2 s`, `2 min 05 s`, `2 h 01 min`; `?` where it is not known."""
    if seconds is None or not math.isfinite(seconds):
        return "?"
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s" if whole >= 10 else f"{seconds:.1f} s"
    return (
        f"{whole // 60} min {whole % 60:02d} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    )


def fit(parts: Sequence[str], room: int, joint: str = ", ", count: bool = True) -> str:
    """The first parts that fit into `room` characters, then (`count`) how many more; nothing if not even one fits."""
    for shown in range(len(parts), 0, -1):
        more = [f"+{len(parts) - shown} more"] if count and shown < len(parts) else []
        text = joint.join([*parts[:shown], *more])
        if len(text) <= room:
            return text
    return ""


def named(names: Sequence[str], values: Mapping[str, float]) -> list[str]:
    return [f"{name} {float(value):.2g}" for name, value in zip(names, values.values(), strict=True)]


def without_prefix(names: Sequence[str]) -> list[str]:
    """Names without the words that all begin with: `pendulum_mass`, `pendulum_length` -> `mass`, `length`."""
    common = os.path.commonprefix(list(names)) if len(names) > 1 else ""
    cut = max(common.rfind("_"), common.rfind(".")) + 1
    return [name[cut:] for name in names]


def escape(text: str) -> str:
    from rich.markup import escape

    return escape(text)


def ascii_of(text: str) -> str:
    """The nearest text of ASCII characters: `(1.2 ± 0.3)·10⁻⁶` -> `(1.2 +/- 0.3)*10^-6`."""
    for sign, words in (("±", "+/-"), ("…", "..."), ("–", "-"), ("−", "-"), ("·", "*"), ("×", "x"), ("─", "-")):
        text = text.replace(sign, words)
    text = re.sub("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda found: "^" + found[0].translate(_PLAIN), text)
    return text.encode("ascii", "replace").decode()
