"""Densities: the part of the network between standardised summaries and the heads of the mixture.

The heads (mdn.py) make a mixture of Gaussians of whatever a density computes, as products, quotients, marginals and
corrections need closed forms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jax import Array

from bayessim_mjx.config.names import DENSITIES
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.settings import InferenceSettings

Params = dict[str, Any]
Drop = tuple[Array, Array]  # key, rate
# of the parameters, those of the network itself: a density's own ones have other names
TAKEN = ("layers", "skip", "embedding", "used", "sharpness", "share", "member")


@dataclass(frozen=True)
class Density:
    """All that is known of one density. n rows, D features (or learned ones), H hidden units, d parameters.

    Args:
        name: a word, the first of `bayessim.modelClass`.
        start: (key, settings, D) -> (own parameters by name, widths of the dense layers below the heads, their input
            first). Layers of those widths are made and trained by the network: `params["layers"][:-1]`, each with `w`
            and `b`. A single width H: `hidden` makes the features by its own parameters.
        hidden: (params, x [n, D], drop) -> [n, H]. drop is None, or a key and a rate of units to leave out in training.
        ending: a function of what follows the name in settings (`settings.density`); ValueError with a reason where
            that is wrong. None: nothing may follow.
        fixed: own parameters that are not trained by gradients.
        prepare: (params, x [N, D], y [N, d], train [N], held [N], settings) -> params with what a first fit sets by its
            data; rows are used where train or held is True. None: nothing.
        regressed: whether the heads' weights start at a regression on the hidden features as well as on the summaries:
            for features that do not change in training. Their means should be 0: the regression has no intercept for
            them.
        whitened: whether whitened summaries are tried too (whitening.py).
    """

    name: str
    start: Callable[[Array, InferenceSettings, int], tuple[Params, tuple[int, ...]]]
    hidden: Callable[[Params, Array, Drop | None], Array]
    ending: Callable[[str], Any] | None = None
    fixed: tuple[str, ...] = ()
    prepare: Callable[[Params, Array, Array, Array, Array, InferenceSettings], Params] | None = None
    regressed: bool = False
    whitened: bool = True


def register(density: Density) -> Density:
    """Add a density, so that `bayessim.modelClass` may name it; returns it.

    Raises:
        UserError: a name that is the library's, or that is not one word of letters and digits.
    """
    return DENSITIES.register(density)


def density_of(settings: InferenceSettings) -> Density:
    """Find the density that settings.modelClass names."""
    return DENSITIES.entry(settings.density[0])


def started(key: Array, settings: InferenceSettings, dim_x: int) -> tuple[Params, tuple[int, ...]]:
    """Call a density's `start` and check its answer.

    Raises:
        UserError: where its parameters or widths cannot be used.
    """
    density = density_of(settings)
    own, widths = density.start(key, settings, dim_x)
    clash = sorted(set(own) & set(TAKEN))
    if clash or set(density.fixed) - set(own):
        raise UserError(
            f"density {density.name!r}: its parameters are {', '.join(own) or 'none'}; names that the network has for "
            f"itself: {', '.join(TAKEN)}; fixed has to be some of its own: {', '.join(density.fixed) or 'none'}"
        )
    if not widths or any(width < 1 for width in widths):
        raise UserError(f"density {density.name!r}: widths = {widths}: at least one, each of 1 or more")
    return own, widths
