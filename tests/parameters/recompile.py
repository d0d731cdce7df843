"""`assert_write_equals_recompile`: writing theta gives the model that MuJoCo compiles from the edited MJCF."""

from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.constants import mjx

# what mjx.Model holds but cannot follow a traced change: the lights' rest poses (only rendering reads them, and the
# model does not say which body carries a light); MuJoCo C's shortcut flags for coinciding frames, which MJX never
# reads; host numbers that size the patches of height fields
EXEMPT = (".light_poscom0", ".body_sameframe", ".geom_sameframe", ".site_sameframe", "._impl.geom_rbound_hfield")
# fields that mix units are compared column by column
MIXED = (".body_invweight0", ".eq_data", ".actuator_gainprm", ".actuator_biasprm", ".geom_aabb", ".geom_size")


def spec_of(model: mujoco.MjSpec | str | Path) -> mujoco.MjSpec:
    """A spec from a spec, an XML string, or an XML file."""
    if isinstance(model, mujoco.MjSpec):
        return model
    text = str(model)
    return mujoco.MjSpec.from_string(text) if text.lstrip().startswith("<") else mujoco.MjSpec.from_file(text)


def random_thetas(space: ParameterSpace, count: int, seed: int = 0) -> np.ndarray:
    """Draws from the prior, `[count, d]`."""
    u = np.random.default_rng(seed).uniform(size=(count, len(space)))
    return np.asarray(space.from_unit(u))


def assert_write_equals_recompile(
    model: mujoco.MjSpec | str | Path, space: ParameterSpace, theta: Any, rtol: float = 1e-5
) -> None:
    """Every field of `mjx.Model`, relative to max(|reference|, scale of that field), for theta `[d]` or `[n, d]`.

    The scale of a field is 1e-3 of its largest number (per column where columns differ in unit).
    """
    spec = spec_of(model)
    nominal = mjx.put_model(spec.copy().compile(), impl="jax")
    write = jax.jit(lambda t: space.write(nominal, t))
    for row in np.atleast_2d(np.asarray(theta, np.float32)):
        expected = mjx.put_model(space.edit(spec, row).compile(), impl="jax")
        worst = errors(write(row), expected)
        bad = {k: v for k, v in worst.items() if not v <= rtol}
        values = space.as_dict(row)
        assert not bad, f"relative errors {bad} at {values}"


def errors(got: Any, expected: Any) -> dict[str, float]:
    """Largest relative error by field, over traced leaves and host fields alike."""
    found = {}
    one, two = _fields(got), _fields(expected)
    assert one.keys() == two.keys(), "the models differ in structure"
    for name, value in two.items():
        if name not in EXEMPT:
            found[name] = _error(np.asarray(one[name]), np.asarray(value), name)
    return found


def _fields(model: Any, prefix: str = "") -> dict[str, Any]:
    """All fields of a model, nested ones by dotted name."""
    fields: dict[str, Any] = {}
    for field in type(model).fields():
        value, name = getattr(model, field.name), f"{prefix}.{field.name}"
        if hasattr(type(value), "fields") and not isinstance(value, np.ndarray):
            fields |= _fields(value, name)
        elif isinstance(value, (np.ndarray, jax.Array, int, float, np.generic)):
            fields[name] = value
    return fields


def _error(got: np.ndarray, expected: np.ndarray, name: str) -> float:
    if got.shape != expected.shape:
        return np.inf
    if expected.size == 0 or np.array_equal(got, expected):
        return 0.0
    got, expected = got.astype(np.float64), expected.astype(np.float64)
    axis = 0 if name in MIXED and expected.ndim == 2 else None
    scale = 1e-3 * np.max(np.abs(expected), axis=axis, keepdims=axis is not None)
    return float(np.max(np.abs(got - expected) / np.maximum(np.maximum(np.abs(expected), scale), 1e-9)))
