"""Settings of the inference network and its training."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

MODELS = ("MDNN",)


@dataclass(frozen=True)
class InferenceSettings:
    """The first five keep BayesSimIG's names; the training recipe is that of reference/sbi.md section 3.2."""

    modelClass: str = "MDNN"
    components: int = 10
    fullCovariance: bool = True
    hiddenLayers: tuple[int, ...] = (128, 128)
    lr: float = 2e-3  # peak of the cosine schedule
    weight_decay: float = 1e-4
    batch: int = 256
    epochs: int = 100  # passes over the capacity, within [min_steps, max_steps]
    min_steps: int = 1000
    max_steps: int = 4000
    grad_clip: float = 5.0  # global norm
    validation: float = 0.1  # share of rows held out
    restandardise: bool = False  # inputs anew at every fit: for data whose distribution changes from fit to fit
    clip: float = 10.0  # standardised inputs are clipped to +-clip
    defensive: float = 1e-4  # prior mass in every posterior: one that is wildly wrong cannot veto the others

    def __post_init__(self) -> None:
        object.__setattr__(self, "hiddenLayers", tuple(int(width) for width in self.hiddenLayers))
        if self.modelClass not in MODELS:
            raise ValueError(f"modelClass = {self.modelClass!r}: this version has {', '.join(MODELS)}")
        for name in ("components", "batch", "epochs", "min_steps", "max_steps", "lr", "grad_clip", "clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} = {getattr(self, name)!r} must be positive")
        if not 0 < self.validation < 1:
            raise ValueError(f"validation = {self.validation!r} must lie between 0 and 1")
        if not 0 <= self.defensive < 1:
            raise ValueError(f"defensive = {self.defensive!r} must lie in [0, 1)")
        if any(width < 1 for width in self.hiddenLayers):
            raise ValueError(f"hiddenLayers = {self.hiddenLayers!r}: widths must be positive")

    @classmethod
    def of(cls, section: Any, **overrides: Any) -> InferenceSettings:
        """Take the fields that `section` (e.g. the `bayessim:` configuration) has; the rest keep their defaults."""
        known = {f.name: getattr(section, f.name) for f in fields(cls) if hasattr(section, f.name)}
        return cls(**{**known, **overrides})
