"""Diagnoses written by hand: known parameters and effects at given values, nothing else."""

from collections.abc import Mapping, Sequence

from bayessim_mjx.diagnosis.result import Diagnosis, Estimate, FoundEffect, Gap

Found = tuple[str, str, dict[str, tuple[float, float]]]  # name, where, {parameter: (mean, sd)}


def diagnosis(found: Sequence[Found], parameters: Mapping[str, tuple[float, float]] | None = None) -> Diagnosis:
    """The verdict "effects" with these; `parameters` are scales, 1 within 20 %."""
    effects = [
        FoundEffect(name, where, {p: Estimate(m, s) for p, (m, s) in values.items()}, 1.0, 0.9, (0.8, 0.95))
        for name, where, values in found
    ]
    known = {
        n: {"mean": m, "sd": s, "nominal": 1.0, "low": 0.8, "high": 1.2, "unit": "", "structural": ""}
        for n, (m, s) in (parameters or {}).items()
    }
    gap = Gap(1.0, 30.0, 20.0, 1.1, 1.0)
    return Diagnosis("effects", [], effects, [], gap, known, [], [], {}, {})
