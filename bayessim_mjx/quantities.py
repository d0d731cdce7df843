"""Numbers as people read them: a value and its uncertainty are rounded together, to the same decimal place."""

import math
from typing import Any, TypeGuard

MISSING = "–"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DIGITS = 2  # of an uncertainty: more are never known (GUM, JCGM 100:2008, 7.2.6)
PLAIN = range(-4, 6)  # powers of ten that are written without an exponent
EXACT = 1e-6  # an uncertainty below this share of the value is not shown


def finite(value: Any) -> TypeGuard[float]:
    """A number that can be shown; None, NaN, infinities and text cannot."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def power(value: float) -> int:
    """The exponent of the first digit: 0.031 -> -2."""
    return math.floor(math.log10(abs(value))) if value else 0


def fixed(value: float, decimals: int) -> str:
    """`decimals` places (rounded to tens, hundreds where negative), never a negative zero."""
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text if float(text) else text.lstrip("-")


def exponent(p: int) -> str:
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


def percent(share: Any, sign: bool = False) -> str:
    """A share in per cent: whole from 10 % on, two digits below; 99.5 to 99.9 % with a decimal, as they are not all."""
    if not finite(share := float(share) if _is_float(share) else share):
        return MISSING
    size = abs(share)
    places = 1 - power(float(f"{100 * size:.1e}")) if 0 < size < 0.0995 else 1 if 0.995 <= size < 0.9995 else 0
    return ("+" if sign and share > 0 else "") + f"{fixed(100 * share, min(places, 4))} %"


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


def _is_float(value: Any) -> bool:
    """NumPy's and JAX's scalars too."""
    return hasattr(value, "__float__") and not isinstance(value, bool | int)
