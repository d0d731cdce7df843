"""ParameterSpace: an ordered set of parameters. Vector <-> names, unit coordinates, priors, writing into models."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters.parameter import Parameter

if TYPE_CHECKING:
    import mujoco
    from mujoco import mjx


from typing import Protocol

from jax.scipy.special import ndtr, ndtri


@jax.tree_util.register_static
class ParameterSpace:
    """An ordered set of named parameters; theta is a float32 vector `[d]` in this order.

    Immutable, equal and hashable by content: a static argument under `jit`, and as a pytree one without leaves.

    Raises:
        UserError: two parameters of one name.
    """

    low: Any  # numpy's here; arrays where ranges may move (`ranged.Ranged`)
    high: Any

    def __init__(self, parameters: Iterable[Parameter] = ()) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(p.name for p in self.parameters)
        self.units = tuple(p.unit for p in self.parameters)
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise UserError(f"parameters named twice: {', '.join(twice)}")
        self.low, self.high, self.nominal = (_frozen(getattr(p, k) for p in self.parameters) for k in _VECTORS)
        self._index = {name: i for i, name in enumerate(self.names)}

    @classmethod
    def from_config(cls, randomization_params: Mapping[str, Any], mj_model: "mujoco.MjModel") -> "ParameterSpace":
        """Make the space of a `randomization_params` section in BayesSimIG's YAML format (see `reading.py`).

        Without the parameters of its `effects`, which `effects.support.reading.stack` makes.

        Raises:
            UserError: unknown actor, group, attribute or element; empty range; scaling of a number that is 0.
        """
        from bayessim_mjx.parameters import reading

        return cls(reading.read(randomization_params, mj_model))

    @property
    def unbatched(self) -> "ParameterSpace":
        """The space of one distribution of a batch."""
        return self

    def __len__(self) -> int:
        return len(self.parameters)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ParameterSpace) and self.parameters == other.parameters

    def __hash__(self) -> int:
        return hash(self.parameters)

    def __repr__(self) -> str:
        return f"ParameterSpace({', '.join(self.names)})"

    def __add__(self, other: "ParameterSpace") -> "ParameterSpace":
        return ParameterSpace(self.parameters + other.parameters)

    def index(self, name: str) -> int:
        """Position of a parameter in theta; UserError with close matches if there is none of that name."""
        if name in self._index:
            return self._index[name]
        close = difflib.get_close_matches(name, self.names, 3)
        hint = f"did you mean {', '.join(close)}?" if close else f"there are: {', '.join(self.names) or 'none'}"
        raise UserError(f"no parameter {name!r}; {hint}")

    def subset(self, names: Sequence[str]) -> "ParameterSpace":
        """Keep the named parameters, in the order given."""
        return ParameterSpace(self.parameters[self.index(name)] for name in names)

    def vector(self, values: Mapping[str, float] | Sequence[float] | np.ndarray) -> np.ndarray:
        """Values -> theta `[d]`, float32. A mapping may leave parameters out: these are nominal."""
        if isinstance(values, Mapping):
            theta = self.nominal.copy()
            for name, value in values.items():
                theta[self.index(name)] = value
            return theta
        theta = np.asarray(values, np.float32)
        if theta.shape != (len(self),):
            raise UserError(f"{len(self)} parameters ({', '.join(self.names)}) but values of shape {theta.shape}")
        return theta

    def as_dict(self, theta: Any) -> dict[str, float]:
        """theta `[d]` -> {name: value}."""
        return {name: float(value) for name, value in zip(self.names, self.vector(theta), strict=True)}

    def contains(self, theta: Any) -> jax.Array:
        """theta `[..., d]` -> bool `[...]`: inside the box, ends included."""
        theta = jnp.asarray(theta)
        return jnp.all((theta >= self.low) & (theta <= self.high), axis=-1)

    def to_unit(self, theta: Any) -> jax.Array:
        """Elementwise prior CDF, `[..., d]` -> [0, 1]: every prior is uniform on the unit cube in these coordinates."""
        return to_unit(self, jnp.asarray(theta, jnp.float32))

    def from_unit(self, u: Any) -> jax.Array:
        """Inverse of `to_unit`, `[..., d]`; never outside [low, high]."""
        return from_unit(self, jnp.asarray(u, jnp.float32))

    def scheduled(self, theta: Any, clock: jax.Array) -> jax.Array:
        """theta `[..., d]` as training draws it after `clock` control steps: nominal + strength * (theta - nominal)."""
        if not any(p.schedule.steps for p in self.parameters):
            return theta
        strength = jnp.stack([p.schedule.strength(clock) for p in self.parameters])
        return jnp.where(strength == 1.0, theta, self.nominal + strength * (theta - self.nominal))

    def log_prior(self, theta: Any) -> jax.Array:
        """Joint log density of the priors in theta units, `[..., d]` -> `[...]`; -inf outside the box."""
        theta = jnp.asarray(theta, jnp.float32)
        return jnp.where(self.contains(theta), jnp.sum(log_density(self, theta), axis=-1), -jnp.inf)

    def write(self, model: "mjx.Model", theta: Any, derived: bool = True) -> "mjx.Model":
        """Write theta `[d]` into the nominal `model`, derived constants recomputed. Pure; use under `vmap`.

        Changes are relative to `model`, so always pass the nominal one. Leaves that no parameter concerns stay the
        identical objects. Parameters of kind "effect" are ignored.

        Args: derived: whether those constants are; False where more changes follow before they are needed.
        """
        from bayessim_mjx.parameters import writing

        return writing.write(self.parameters, model, theta, derived)

    def edit(self, spec: "mujoco.MjSpec", theta: Any) -> "mujoco.MjSpec":
        """Make the same change in a copy of the nominal MJCF `spec`; it compiles to what `write` makes."""
        from bayessim_mjx.parameters import editing

        return editing.edit(self.parameters, spec, self.vector(theta))


_VECTORS = ("low", "high", "nominal")


def _frozen(values: Iterable[float]) -> np.ndarray:
    array = np.asarray(list(values), np.float32)
    array.setflags(write=False)
    return array


# Prior CDF, its inverse and log density, elementwise over the parameters of a space


class Space(Protocol):
    """What is read of a `ParameterSpace`, `[d]` each."""

    parameters: tuple[Parameter, ...]
    low: Any  # numpy's, known when a program is compiled, or arrays of a `Ranged` space
    high: Any


def _library(space: Space) -> Any:
    """Choose the library that computes with the ends of the ranges: constants stay numpy's."""
    return np if isinstance(space.low, np.ndarray) else jnp


def to_unit(space: Space, theta: jax.Array) -> jax.Array:
    """theta `[..., d]` -> CDF values `[..., d]`; 0 below and 1 above the range."""
    theta = jnp.clip(theta, space.low, space.high)
    u = (theta - space.low) / (space.high - space.low)
    log, gauss = _is(space, "loguniform"), _is(space, "gaussian")
    if log.any():
        xp = _library(space)
        low, high = xp.where(log, space.low, 1.0), xp.where(log, space.high, 2.0)
        # u = ln(theta / low) / ln(high / low)
        u = jnp.where(log, jnp.log(jnp.where(log, theta, 1.0) / low) / xp.log(high / low), u)
    if gauss.any():
        mean, sd, a, b = _normal(space)
        # u = (Phi(z) - Phi(a)) / (Phi(b) - Phi(a))
        u = jnp.where(gauss, (ndtr((theta - mean) / sd) - ndtr(a)) / (ndtr(b) - ndtr(a)), u)
    return jnp.clip(u, 0.0, 1.0)


def from_unit(space: Space, u: jax.Array) -> jax.Array:
    """CDF values `[..., d]` -> theta `[..., d]`, clipped to the range."""
    u = jnp.clip(u, 0.0, 1.0)
    theta = space.low + u * (space.high - space.low)
    log, gauss = _is(space, "loguniform"), _is(space, "gaussian")
    if log.any():
        xp = _library(space)
        low, high = xp.where(log, space.low, 1.0), xp.where(log, space.high, 2.0)
        theta = jnp.where(log, low * jnp.exp(u * xp.log(high / low)), theta)
    if gauss.any():
        mean, sd, a, b = _normal(space)
        theta = jnp.where(gauss, mean + sd * ndtri(ndtr(a) + u * (ndtr(b) - ndtr(a))), theta)
    # the ends exactly, and no rounding beyond them
    theta = jnp.where(u <= 0.0, space.low, jnp.where(u >= 1.0, space.high, theta))
    return jnp.clip(theta, space.low, space.high)


def log_density(space: Space, theta: jax.Array) -> jax.Array:
    """Log density per parameter `[..., d]`, in theta units; meaningful inside the range only."""
    xp = _library(space)
    width = (space.high - space.low).astype(np.float64 if xp is np else np.float32)
    density = jnp.broadcast_to(jnp.asarray(-xp.log(width), jnp.float32), theta.shape)
    log, gauss = _is(space, "loguniform"), _is(space, "gaussian")
    if log.any():
        low, high = xp.where(log, space.low, 1.0), xp.where(log, space.high, 2.0)
        # p = 1 / (theta ln(high / low))
        safe = jnp.where(log & (theta > 0), theta, 1.0)
        density = jnp.where(log, -jnp.log(safe) - xp.log(xp.log(high / low)), density)
    if gauss.any():
        mean, sd, a, b = _normal(space)
        z = (theta - mean) / sd
        mass = jnp.log(ndtr(b) - ndtr(a))
        density = jnp.where(gauss, -0.5 * z**2 - jnp.log(sd) - 0.5 * np.log(2 * np.pi) - mass, density)
    return density


def _is(space: Space, prior: str) -> np.ndarray:
    return np.asarray([p.prior == prior for p in space.parameters], bool)


def _normal(space: Space) -> tuple[np.ndarray, np.ndarray, Any, Any]:
    """mean, sd and the standardised ends; harmless numbers in the columns of other priors."""
    gauss = _is(space, "gaussian")
    mean = np.asarray([p.mean if g else 0.0 for p, g in zip(space.parameters, gauss, strict=True)], np.float32)
    sd = np.asarray([p.sd if g else 1.0 for p, g in zip(space.parameters, gauss, strict=True)], np.float32)
    xp = _library(space)
    a, b = xp.where(gauss, (space.low - mean) / sd, -1.0), xp.where(gauss, (space.high - mean) / sd, 1.0)
    return mean, sd, a.astype(np.float32), b.astype(np.float32)
