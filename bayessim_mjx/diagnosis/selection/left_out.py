"""What a search did not fit, and why: told with its result, as an effect that was not fitted is not ruled out."""

from __future__ import annotations

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.selection.budget import SINGLES
from bayessim_mjx.diagnosis.selection.tried import Tried

TOLD = 0.25  # of the time, from which on it is told that this was gone before the search


def not_fitted(tried: Tried) -> dict[str, list[str]]:
    """{reason: labels of candidates that are in no model}, of reasons that there are."""
    fitted = frozenset().union(*tried.models)
    gains = {s.candidate.label: s.gain for s in tried.screened}
    out: dict[str, list[str]] = {}
    for label in (c.label for c in tried.candidates if c.label not in fitted):
        out.setdefault(_reason(tried, label, gains), []).append(label)
    return out


def not_tried(tried: Tried) -> str:
    """What the time was too short for, in words; "" where nothing was left out."""
    parts = [f"{count} models ({part})" for part, count in tried.skipped.items() if part != SINGLES]
    if tried.cut_short:
        parts.insert(0, f"{len(tried.cut_short)} single effects")
    if not parts:
        return ""
    budget = tried.settings.budget
    text = f"In {budget.seconds / 60:.3g} minutes not everything was tried: no time was left for {' and '.join(parts)}."
    first = f" Before the search, looking at the logs and compiling took {budget.fixed / 60:.2g} of them."
    return text + first * (budget.fixed > TOLD * budget.seconds)


def _reason(tried: Tried, label: str, gains: dict[str, float]) -> str:
    if label in tried.cut_short:
        return phrases.NO_TIME_LEFT
    if label not in gains:
        return phrases.NOT_SCREENED
    if gains[label] <= 0.0:
        return phrases.NO_GAIN
    return phrases.LESS_PROMISING if tried.above_noise(tried.base) else phrases.NOTHING_LEFT
