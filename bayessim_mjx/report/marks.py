"""Small inline SVG marks for tables: a dot with its interval on a scale that all rows share."""

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from bayessim_mjx.quantities import finite
from bayessim_mjx.report.words import known_span

WIDTH, HEIGHT, PAD = 190, 18, 6


def scale_of(values: Sequence[Any], zero: bool = True) -> tuple[float, float]:
    """Return common limits of what is drawn, a little wider; with 0 inside where asked for."""
    known = [float(v) for v in values if finite(v)] + ([0.0] if zero else [])
    low, high = min(known, default=0.0), max(known, default=1.0)
    room = 0.03 * (high - low) or 0.5 * abs(high) or 0.5
    return low - room * (low < 0 or not zero), high + room


def interval(
    value: Any,
    ci: Sequence[Any] | None,
    limits: tuple[float, float],
    colour: str,
    ticks: Sequence[Any] = (),
    hollow: Any = None,
    inner: Sequence[Any] | None = None,
    width: int = WIDTH,
) -> Markup:
    """Draw a dot at `value`, a line over `ci`, a thick one over `inner`, ticks at `ticks`, a hollow dot at `hollow`."""

    def at(x: Any) -> float:
        share = (float(x) - limits[0]) / (limits[1] - limits[0])
        return round(PAD + (width - 2 * PAD) * min(max(share, 0.0), 1.0), 1)

    y = HEIGHT / 2
    parts = [f'<line class="track" x1="{PAD}" x2="{width - PAD}" y1="{y}" y2="{y}"/>']
    parts += [f'<line class="tick" x1="{at(t)}" x2="{at(t)}" y1="1" y2="{HEIGHT - 1}"/>' for t in ticks if finite(t)]
    for span, thick in ((known_span(ci), 2), (known_span(inner), 4)):
        if span:
            ends = f'x1="{at(span[0])}" x2="{at(span[1])}" y1="{y}" y2="{y}"'
            parts.append(f'<line {ends} stroke="{colour}" stroke-width="{thick}"/>')
    if finite(hollow):
        parts.append(f'<circle cx="{at(hollow)}" cy="{y}" r="4" fill="#fff" stroke="{colour}" stroke-width="1.5"/>')
    if finite(value):
        parts.append(f'<circle cx="{at(value)}" cy="{y}" r="4.5" fill="{colour}"/>')
    return _svg(parts, width)


def bar(share: Any, ci: Sequence[Any] | None, colour: str, width: int = WIDTH) -> Markup:
    """Draw a bar from 0 to `share` of 1 with its interval as a line."""
    full = width - 2 * PAD

    def at(x: Any) -> float:
        return round(PAD + full * min(max(float(x), 0.0), 1.0), 1)

    y = HEIGHT / 2
    parts = [f'<line class="track" x1="{PAD}" x2="{width - PAD}" y1="{y}" y2="{y}"/>']
    if finite(share):
        parts.append(
            f'<rect x="{PAD}" y="3" width="{round(at(share) - PAD, 1)}" height="{HEIGHT - 6}" fill="{colour}"/>'
        )
    ends = known_span(ci)
    if ends:
        parts.append(
            f'<line x1="{at(ends[0])}" x2="{at(ends[1])}" y1="{y}" y2="{y}" stroke="#222" stroke-width="1.5"/>'
        )
        parts += [
            f'<line x1="{at(c)}" x2="{at(c)}" y1="5" y2="{HEIGHT - 5}" stroke="#222" stroke-width="1.5"/>' for c in ends
        ]
    return _svg(parts, width)


def _svg(parts: Sequence[str], width: int) -> Markup:
    head = f'<svg class="mark" width="{width}" height="{HEIGHT}" viewBox="0 0 {width} {HEIGHT}" aria-hidden="true">'
    return Markup(head + "".join(parts) + "</svg>")
