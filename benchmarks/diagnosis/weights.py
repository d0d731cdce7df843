"""Are weights among rivals worth what they say? Brier score and reliability of blind cases, as of probabilities."""

from collections.abc import Sequence

import numpy as np
from score import Outcome, labels_of, wilson

BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def forecasts(outcomes: Sequence[Outcome]) -> list[tuple[float, bool]]:
    """(weight, whether it is of a hidden cause) of every named effect that has rivals, and of each of these."""
    found = []
    for o in outcomes:
        for effect in o.named():
            if not effect["equivalent_to"]:
                continue
            own = effect.get("weight_among_rivals", effect.get("probability"))  # the latter in files of before
            told = [(own, [(effect["name"], str(effect["where"]))])]
            told += [(r.get("weight"), labels_of(r)) for r in effect["equivalent_to"] if isinstance(r, dict)]
            found += [(float(w), _true(o, labels)) for w, labels in told if w is not None]
    return found


def _true(outcome: Outcome, labels: Sequence[tuple[str, str]]) -> bool:
    """Whether all of an explanation's effects are hidden ones."""
    return all(any(outcome.same(*label, e) for e in outcome.truth["effects"]) for label in labels)


def brier(told: Sequence[tuple[float, bool]]) -> tuple[float, float]:
    """(mean squared error of the weights, that of always saying how many are true); smaller is better."""
    weight, true = (np.array([t[i] for t in told], float) for i in (0, 1))
    return float(np.mean((weight - true) ** 2)), float(np.mean((true.mean() - true) ** 2))


def reliability(told: Sequence[tuple[float, bool]]) -> list[list[str]]:
    """Rows of a table: range of weights, how many, their mean, the share that is true with its 95 % interval."""
    weight, true = np.array([w for w, _ in told]), np.array([t for _, t in told], bool)
    rows = []
    for k, (low, high) in enumerate(zip(BINS, BINS[1:], strict=False)):
        own = (weight >= low) & ((weight < high) | (k == len(BINS) - 2))
        if own.any():
            a, b = wilson(int(true[own].sum()), int(own.sum()))
            share = f"{100 * true[own].mean():.0f} % ({100 * a:.0f} to {100 * b:.0f})"
            rows.append([f"{low:g} to {high:g}", str(own.sum()), f"{weight[own].mean():.2f}", share])
    return rows


def table(outcomes: Sequence[Outcome]) -> tuple[str, list[str], list[list[str]]]:
    """Title, header and rows; no rows where nothing has a rival."""
    told = forecasts(outcomes)
    rows = reliability(told) if told else []
    if told:
        own, same = brier(told)
        rows.append(["all", str(len(told)), "", f"Brier score {own:.3f}; of the base rate {same:.3f}"])
    header = ["weight among rivals", "n", "mean weight", "true (95 % interval)"]
    return "Weights among rivals, scored as probabilities", header, rows
