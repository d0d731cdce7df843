"""Settings of the inference network and its training."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from bayessim_mjx.config.settings import COORDINATES, BayesSimConfig, model_of
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from bayessim_mjx.inference.embedding import Embedding


@dataclass(frozen=True)
class InferenceSettings:
    """The first five keep BayesSimIG's names and, like `ensemble` and `coordinates`, have the defaults of `bayessim:`.

    modelClass is MDNN, or MDRFF[_<kernel>[_<bandwidth>]] with the kernels RBF, Matern12 (Laplace), Matern32, Matern52
    and as bandwidth a number (in standard deviations of the features), `median` (of the distances) or `validation`
    (the multiple of the median that a ridge regression predicts held-out rows with best; the default).

    coordinates are those in which the posterior is a Gaussian mixture: `plain` unit coordinates (cut off at the box
    afterwards), `truncated` (the same, cut off in training too), `probit` (the prior is exactly N(0, I) and no
    component is broader; exact for Gaussian priors) or `logit`. `auto` is `probit` where every prior is Gaussian,
    otherwise `plain`: in plain coordinates the Gaussian posterior of a Gaussian prior is bent (0.09 nats a parameter).
    """

    modelClass: str = BayesSimConfig.modelClass or "MDNN"
    components: int = BayesSimConfig.components
    fullCovariance: bool = BayesSimConfig.fullCovariance
    hiddenLayers: tuple[int, ...] = BayesSimConfig.hiddenLayers
    lr: float = BayesSimConfig.lr  # peak of the cosine schedule
    weight_decay: float = 1e-4
    batch: int = 64  # a quarter of the rows in four times the steps: more per second, measured on noise-free data
    epochs: int = 40  # passes over the capacity, within [min_steps, max_steps]
    min_steps: int = 1000
    max_steps: int = 8000
    grad_clip: float = 5.0  # global norm
    validation: float = 0.1  # share of rows held out
    restandardise: bool = False  # inputs anew at every fit: for data whose distribution changes from fit to fit
    clip: float = 10.0  # standardised inputs are clipped to +-clip
    defensive: float = 1e-4  # prior mass in every posterior: one that is wildly wrong cannot veto the others
    coordinates: str = BayesSimConfig.coordinates
    # networks side by side, weighted by held-out score; their posterior has ensemble * components Gaussians. A single
    # one is over-confident at a few thousand simulations: its 50 / 80 / 95 % regions held .31 / .58 / .82 of truths
    ensemble: int = BayesSimConfig.ensemble
    # of the last member, the first has none; less with more than 3000 rows, which need none and suffer
    dropout: float = 0.1
    fourierFeatures: int = 256  # frequencies of MDRFF: twice as many features
    embedding: Embedding | None = None  # trained with the network, which then takes in rows of summary_learned

    def __post_init__(self) -> None:
        object.__setattr__(self, "hiddenLayers", tuple(int(width) for width in self.hiddenLayers))
        model_of(str(self.modelClass))
        positive = ("components", "batch", "epochs", "min_steps", "max_steps", "lr", "grad_clip", "clip")
        for name in (*positive, "ensemble", "fourierFeatures"):
            if not getattr(self, name) > 0:
                raise UserError(f"{name} = {getattr(self, name)!r} must be positive")
        if not 0 < self.validation < 1:
            raise UserError(f"validation = {self.validation!r} must lie between 0 and 1")
        for name in ("defensive", "dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise UserError(f"{name} = {getattr(self, name)!r} must lie in [0, 1)")
        if any(width < 1 for width in self.hiddenLayers):
            raise UserError(f"hiddenLayers = {self.hiddenLayers!r}: widths must be positive")
        if self.coordinates not in COORDINATES:
            raise UserError(f"coordinates = {self.coordinates!r}: allowed are {', '.join(COORDINATES)}")

    @property
    def kernel(self) -> str | None:
        """Kernel of the Fourier features; None for MDNN."""
        return model_of(self.modelClass)[1]

    @property
    def bandwidth(self) -> str:
        """`median`, `validation` or a number, as text."""
        return str(model_of(self.modelClass)[2])

    @property
    def fixed_bandwidth(self) -> float | None:
        """The bandwidth where it is given as a number."""
        width = model_of(self.modelClass)[2]
        return width if isinstance(width, float) else None

    @property
    def chart(self) -> str:
        """Chart of the posterior distributions (distributions/charts.py)."""
        return "plain" if self.coordinates in ("truncated", "auto") else self.coordinates

    def at(self, space: Any) -> InferenceSettings:
        """These settings with the coordinates that suit the priors of `space`, where they are `auto`."""
        if self.coordinates != "auto":
            return self
        gaussian = len(space) > 0 and all(p.prior == "gaussian" for p in space.parameters)
        return replace(self, coordinates="probit" if gaussian else "plain")

    @classmethod
    def of(cls, section: Any, **overrides: Any) -> InferenceSettings:
        """Take the fields that `section` (e.g. the `bayessim:` configuration) has; the rest keep their defaults."""
        known = {f.name: getattr(section, f.name) for f in fields(cls) if hasattr(section, f.name)}
        return cls(**{**known, **overrides})
