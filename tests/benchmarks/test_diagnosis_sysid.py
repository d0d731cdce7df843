"""What mujoco.sysid is given says the same as the library's effects, the benchmark's truth and plain MuJoCo."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx import effects
from bayessim_mjx.blind.reality import plant

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "optimize"):  # the package is there without what it needs
    pytest.skip('mujoco.sysid lacks its dependencies: pip install "mujoco[sysid]"', allow_module_level=True)
import native  # noqa: E402
import sysid as comparison  # noqa: E402
import systems  # noqa: E402

VALUES = {
    "actuator_bias": (0.3,), "actuator_gain": (1.2,), "actuator_saturation": (2.0,), "armature": (0.02,),
    "coulomb_friction": (0.2,), "gravity_tilt": (0.1, -0.07), "joint_spring": (0.4, 0.3),
    "payload": (0.3, 0.05, -0.02, 0.1), "viscous_friction": (0.05,),
}  # fmt: skip
PLACES = {"actuator": "elbow_motor", "joint": "elbow", "body": "lower", "world": "world"}


@pytest.fixture
def xml(tmp_path) -> str:
    path = tmp_path / "model.xml"
    path.write_text(systems.SYSTEMS["two_link"].xml)
    return str(path)


def motion(model: mujoco.MjModel, steps: int = 100, every: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Controls and positions of a run from (0.3, -0.5)."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3, -0.5
    u = np.random.default_rng(0).normal(size=(steps, model.nu))
    q = [data.qpos.copy()]
    for row in u:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, every)
        q.append(data.qpos.copy())
    return u, np.array(q)


def with_effect(xml: str, name: str, values: tuple[float, ...], place: str) -> mujoco.MjModel:
    """Through the modifiers, twice: nothing may accumulate."""
    spec = native.specification(xml, loads=name == "payload")
    nominal = spec.compile()
    params = native.base(nominal)
    parameter = sysid.Parameter(name, values, values, values)
    parameter.modifier = lambda s, p: native.write_effect(nominal, name, [place], s, p)
    params.add(parameter)
    sysid.apply_param_modifiers(params, spec)
    return sysid.apply_param_modifiers(params, spec)


@pytest.mark.parametrize("name", VALUES)
def test_an_effect_for_sysid_moves_the_robot_as_the_librarys_own_native_form(xml, name):
    kind = effects.load(name)
    place = PLACES[kind.kind]
    spec = mujoco.MjSpec.from_file(xml)
    quantities = {q.name: q.neutral for q in kind.quantities}
    told = dict(zip(native.NATIVE[name], VALUES[name], strict=True))
    assert kind(where=place).edit(spec, {place: quantities | told}) is None
    _, ours = motion(spec.compile())
    _, theirs = motion(with_effect(xml, name, VALUES[name], place))
    _, plain = motion(mujoco.MjModel.from_xml_path(xml))
    assert np.abs(theirs - ours).max() < 1e-6 < 1e-4 < np.abs(plain - ours).max()


def test_quadratic_drag_is_minus_c_w_w(xml):
    model = with_effect(xml, "quadratic_drag", (0.3,), "elbow")
    data = mujoco.MjData(model)
    for w in (2.0, -3.0):
        data.qvel[1] = w
        mujoco.mj_forward(model, data)
        assert data.qfrc_passive[1] == pytest.approx(-model.dof_damping[1] * w - 0.3 * w * abs(w))


def test_base_factors_compile_to_the_benchmarks_own(xml):
    spec = native.specification(xml)
    params = native.base(spec.compile())
    factors = {n: 0.85 + 0.05 * i for i, n in enumerate(params.keys())}
    params.update_from_vector(np.array(list(factors.values())))
    theirs = sysid.apply_param_modifiers(params, spec)
    expected = mujoco.MjSpec.from_file(xml)
    plant.scale_base(expected, factors)
    model = expected.compile()
    for field in ("body_mass", "body_inertia", "dof_damping", "dof_armature"):
        np.testing.assert_allclose(getattr(theirs, field), getattr(model, field), rtol=1e-12)


def test_its_own_motion_has_no_error_and_is_fitted_back(xml):
    spec = native.specification(xml)
    model, params = spec.compile(), native.base(spec.compile())
    wrong = params.as_vector() * np.linspace(0.85, 1.15, params.size)
    params.update_from_vector(wrong)
    moved = sysid.apply_param_modifiers(params, native.specification(xml))
    u, q = motion(moved, every=2)
    state = sysid.create_initial_state(model, q[0], np.zeros(2), act=np.zeros(0))
    data = comparison.sequences(spec, [(state, u, q)], 2 * model.opt.timestep)
    assert comparison.error(data, params) < 1e-9  # no lag, controls held
    _, found = comparison.optimise(data, native.base(model))
    np.testing.assert_allclose(found.as_vector(), wrong, rtol=1e-3)
