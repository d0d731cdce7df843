"""Numbers, shares, units, durations and counts as people read them, the same on the terminal, in pictures and reports.

A value and its uncertainty are rounded together, to the same decimal place.
"""

import math
import re
from collections.abc import Sequence
from typing import Any, TypeGuard

MISSING = "–"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PLAIN_DIGITS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
DIGITS = 2  # of an uncertainty: more are never known (GUM, JCGM 100:2008, 7.2.6)
PLAIN = range(-4, 6)  # powers of ten that are written without an exponent
GAUSSIAN = (
    0.2  # by which both halves of a 68 % interval and the sd differ at most, of the least: a Gaussian's are equal
)
EXACT = 1e-6  # an uncertainty below this share of the value is not shown


def finite(value: Any) -> TypeGuard[float]:
    """Tell whether x is a number that can be shown; None, NaN, infinities and text cannot."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_number(value: Any) -> bool:
    """Tell whether x is a number: also a scalar of NumPy or JAX, and an infinity, but no NaN and no text."""
    try:
        return value is not None and not isinstance(value, str) and not math.isnan(float(value))
    except (TypeError, ValueError):
        return False


def power(value: float) -> int:
    """Compute the exponent of the first digit: 0.031 -> -2."""
    return math.floor(math.log10(abs(value))) if value else 0


def fixed(value: float, decimals: int) -> str:
    """`decimals` places (rounded to tens, hundreds where negative), never a negative zero."""
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text if float(text) else text.lstrip("-")


def exponent(p: int) -> str:
    """`·10⁻⁶`."""
    return f"·10{str(p).translate(SUPERSCRIPT)}"


def number(value: Any, digits: int = 3) -> str:
    """`digits` significant digits without an exponent where people read none; "–" where there is no number."""
    if not finite(value):
        return MISSING
    if isinstance(value, int) or value == 0:
        return f"{value:.0f}"
    if power(value) not in PLAIN:
        p = power(value)
        return f"{fixed(value / 10**p, digits - 1)}{exponent(p)}"
    text = f"{value:.{max(digits - 1 - power(float(f'{value:.{digits - 1}e}')), 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text and abs(value) >= 10**digits else text


def compact(value: Any, digits: int = 4) -> str:
    """`digits` significant digits, whole numbers as such, large ones with k and M: for lines on the terminal."""
    x = float(value)
    if abs(x) >= 1e6 and math.isfinite(x):
        return f"{x / 1e6:.{digits}g}M"
    if abs(x) >= 1e4 and math.isfinite(x):
        return f"{x / 1e3:.{digits}g}k"
    return f"{x:.{digits}g}"


def ordinal(n: int) -> str:
    """`1st`, `2nd`, `3rd`, `4th`, `11th`."""
    return f"{n}{'th' if n % 100 in (11, 12, 13) else {1: 'st', 2: 'nd', 3: 'rd'}.get(n % 10, 'th')}"


def percent(share: Any, sign: bool = False) -> str:
    """Write a share in per cent: whole from 10 % on, two digits below; 99.5 to 99.9 % with a decimal, as not all."""
    if not finite(share := float(share) if _is_float(share) else share):
        return MISSING
    size = abs(share)
    places = 1 - power(float(f"{100 * size:.1e}")) if 0 < size < 0.0995 else 1 if 0.995 <= size < 0.9995 else 0
    return ("+" if sign and share > 0 else "") + f"{fixed(100 * share, min(places, 4))} %"


def p_value(p: float) -> str:
    """`p = 0.0012`; below a thousand-millionth only that it is."""
    return f"p = {p:.2g}" if p >= 1e-9 else "p < 1e-9"


def estimate(value: Any, uncertainty: Any = math.nan, digits: int = DIGITS) -> str:
    """`0.0312 ± 0.0021`: `digits` significant digits of the uncertainty, the value to the same decimal place.

    Without an uncertainty (not finite, not positive, or under a millionth of the value) the value alone.
    """
    value, uncertainty = (float(v) if _is_float(v) else v for v in (value, uncertainty))
    if not finite(value) or not finite(uncertainty) or uncertainty <= EXACT * abs(value):
        return number(value)
    uncertainty = float(f"{uncertainty:.{digits - 1}e}")  # 0.0996 is 0.10, not 0.100
    largest = max(power(value), power(uncertainty))
    if largest not in PLAIN:
        return f"({estimate(value / 10**largest, uncertainty / 10**largest, digits)}){exponent(largest)}"
    places = digits - 1 - power(uncertainty)
    return f"{fixed(value, places)} ± {fixed(uncertainty, places)}"


def spread(median: float, low: float, high: float, sd: float) -> str:
    """`1.04 ± 0.06`, or `1.04 +0.09/-0.05`, where a standard deviation does not say where 68 % lie: low to high."""
    above, below = float(high) - float(median), float(median) - float(low)
    if not all(map(finite, (above, below, float(sd)))) or max(above, below) <= EXACT * abs(float(median)):
        return number(float(median))
    if max(above, below, float(sd)) <= (1 + GAUSSIAN) * min(above, below, float(sd)):
        return estimate(median, 0.5 * (above + below))
    p = max(power(float(median)), power(max(above, below)))
    if p not in PLAIN:
        scaled = (float(v) / 10**p for v in (median, low, high, sd))
        return f"({spread(*scaled)}){exponent(p)}"
    places = DIGITS - 1 - power(max(min(above, below), 0.1 * max(above, below)))  # of the smaller, if it is not tiny
    return f"{fixed(float(median), places)} +{fixed(above, places)}/-{fixed(below, places)}"


def percent_estimate(share: Any, uncertainty: Any, digits: int = DIGITS) -> str:
    """`93.0 ± 1.2 %`: a share and its uncertainty, see `estimate`."""
    return f"{estimate(100 * share, 100 * uncertainty, digits)} %"


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


def count(n: int, thing: str) -> str:
    """`1 log`, `2 logs`."""
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


MOST = 6  # things that a sentence lists: all joints of an arm; a rule of thumb


def listed(names: Sequence[str], last: str = "and", most: int | None = None) -> str:
    """Join `a, b and c`; where there are more than `most`, the first and how many more: `a, b and 5 more`."""
    some, more = list(names[:most]), len(names) - len(names[:most])
    some += [f"{more} more"] if more else []
    return f" {last} ".join([", ".join(some[:-1]), some[-1]]) if len(some) > 1 else "".join(some)


def size(count: float) -> str:
    """Bytes: `1.5 GB`."""
    for unit_, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")):
        if count >= unit_:
            return f"{count / unit_:.3g} {name}"
    return f"{count:.0f} bytes"


def extent(value: float, unit: str) -> str:
    """`0.0087` rad -> `0.50 deg`; `0.0012` m -> `1.2 mm`: two digits, three from ten on."""
    if unit == "rad":
        value, unit = math.degrees(value), "deg"
    elif abs(value) < 1.0:
        value, unit = 1e3 * value, "mm"
    digits = 1 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{min(max(digits, 1 if abs(value) < 99.5 else 0), 6)}f} {unit}"


def unit(text: str) -> str:
    """`N m s^2/rad^2` -> `N m s²/rad²`."""
    parts = text.split("^")
    return parts[0] + "".join(p[:1].translate(SUPERSCRIPT) + p[1:] for p in parts[1:])


def typeset(text: str) -> str:
    """Typeset a number for a page: with a minus sign in place of a hyphen."""
    return text.replace("-", "−")


def ascii_of(text: str) -> str:
    """Write the nearest text of ASCII characters: `(1.2 ± 0.3)·10⁻⁶` -> `(1.2 +/- 0.3)*10^-6`."""
    for sign, words in (("±", "+/-"), ("…", "..."), ("–", "-"), ("−", "-"), ("·", "*"), ("×", "x"), ("─", "-")):
        text = text.replace(sign, words)
    text = re.sub("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda found: "^" + found[0].translate(PLAIN_DIGITS), text)
    return text.encode("ascii", "replace").decode()


def _is_float(value: Any) -> bool:
    """NumPy's and JAX's scalars too."""
    return hasattr(value, "__float__") and not isinstance(value, bool | int)
