"""Settings of the inference network and its training."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from bayessim_mjx.config.names import model_of
from bayessim_mjx.config.settings import BayesSimConfig, Section, setting
from bayessim_mjx.errors import UserError


def _of_run(name: str) -> Any:
    """Copy the setting `bayessim.<name>`: its default, meaning and limits stand there alone."""
    given = BayesSimConfig.__dataclass_fields__[name]
    return field(default=given.default, metadata=given.metadata)


@dataclass(frozen=True)
class InferenceSettings(Section):
    """Settings of the network; those that `bayessim:` has too (config/settings.py) have its defaults and limits.

    modelClass is MDNN, or MDRFF[_<kernel>[_<bandwidth>]] with the kernels RBF, Matern12 (Laplace), Matern32, Matern52
    and as bandwidth a number (in standard deviations of the features), `median` (of the distances) or `validation`
    (the multiple of the median that a ridge regression predicts held-out rows with best; the default); or a density of
    one's own (densities/).

    coordinates are those in which the posterior is a Gaussian mixture: `plain` unit coordinates (cut off at the box
    afterwards), `truncated` (the same, cut off in training too), `probit` (the prior is exactly N(0, I) and no
    component is broader; exact for Gaussian priors) or `logit`. `auto` is `probit` where every prior is Gaussian,
    otherwise `plain`: in plain coordinates the Gaussian posterior of a Gaussian prior is bent (0.09 nats a parameter).

    A single network is over-confident at a few thousand simulations: its 50 / 80 / 95 % regions held .31 / .58 / .82 of
    truths. An ensemble's posterior has ensemble * components Gaussians.
    """

    modelClass: str | None = _of_run("modelClass")  # None is a run without inference: refused here
    components: int = _of_run("components")
    fullCovariance: bool = _of_run("fullCovariance")
    hiddenLayers: tuple[int, ...] = _of_run("hiddenLayers")
    lr: float = _of_run("lr")
    # Sources: batch and dropout, benchmarks/history.md (posteriors); defensive, below; the other numbers are rules of
    # thumb, not counted.
    weight_decay: float = setting(1e-4, "of AdamW", low=0)
    # a quarter of the rows in four times the steps: more per second, measured on noise-free data
    batch: int = setting(64, "rows of a gradient step", low=1)
    epochs: int = setting(40, "passes over the capacity, within [min_steps, max_steps]", low=1)
    min_steps: int = setting(1000, "gradient steps at least", low=1)
    max_steps: int = setting(8000, "gradient steps at most", low=1)
    grad_clip: float = setting(5.0, "largest global norm of a gradient", above=0)
    validation: float = setting(0.1, "share of rows held out, below 1", above=0)
    restandardise: bool = setting(False, "inputs anew at every fit: for data whose distribution changes")
    clip: float = setting(10.0, "standardised inputs are clipped to +- this", above=0)
    defensive: float = setting(
        1e-4, "prior mass in every posterior, below 1: one that is wildly wrong cannot veto the others", low=0
    )
    coordinates: str = _of_run("coordinates")
    ensemble: int = _of_run("ensemble")
    # the first member has none; less with more than 3000 rows, which need none and suffer
    dropout: float = setting(0.1, "of the last member, below 1", low=0)
    fourierFeatures: int = setting(256, "frequencies of MDRFF: twice as many features", low=1)
    embedding: Any = setting(
        None, "trained with the network, which then takes in rows of summary_learned (summaries/learned.py)"
    )

    def __post_init__(self) -> None:
        for f in fields(self):  # numbers of arrays are as good as Python's
            if isinstance(value := getattr(self, f.name), np.generic):
                object.__setattr__(self, f.name, value.item())
        super().__post_init__()

    def check(self) -> None:
        model_of(str(self.modelClass))
        for name in ("validation", "defensive", "dropout"):
            if not getattr(self, name) < 1:
                raise UserError(f"{name} = {getattr(self, name)!r}: must be less than 1")

    @property
    def density(self) -> tuple[str, Any]:
        """Name of the density, and what it makes of the text after the name: of MDRFF, kernel and bandwidth."""
        return model_of(str(self.modelClass))

    @property
    def chart(self) -> str:
        """Chart of the posterior distributions (distributions/charts.py)."""
        return "plain" if self.coordinates in ("matched", "truncated", "auto") else self.coordinates

    def at(self, space: Any) -> InferenceSettings:
        """Return the settings with the coordinates that suit the priors of `space`, where they are `auto`."""
        if self.coordinates != "auto":
            return self
        gaussian = len(space) > 0 and all(p.prior == "gaussian" for p in space.parameters)
        return replace(self, coordinates="probit" if gaussian else "plain")

    @classmethod
    def of(cls, section: Any, **overrides: Any) -> InferenceSettings:
        """Take the fields that `section` (e.g. the `bayessim:` configuration) has; the rest keep their defaults."""
        known = {f.name: getattr(section, f.name) for f in fields(cls) if hasattr(section, f.name)}
        return cls(**{**known, **overrides})
