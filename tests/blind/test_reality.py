"""The finer reality of a user's robot against plain MuJoCo and its native elements."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.blind.reality import twin
from bayessim_mjx.blind.reality.menu import CAUSES, KNOWN, places
from bayessim_mjx.blind.reality.plant import FINER, Plant, base_names, scale_base, scales_of
from bayessim_mjx.blind.reality.strength import Ruler
from bayessim_mjx.blind.robot import load_model, rig_of_logs, rig_of_menu
from bayessim_mjx.errors import UserError
from tests.blind.recorded import PENDULUM, pendulum


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return pendulum(tmp_path_factory.mktemp("blind") / "pendulum")


@pytest.fixture(scope="module")
def rig(folder):
    return rig_of_logs(lambda: load_model(folder / "model.xml"), [str(folder / "logs")], "pendulum")[0]


@pytest.fixture(scope="module")
def scales(rig):
    plain = Plant(rig, {})
    return scales_of(plain, [rig.record(plain, i, 0, noise=False) for i in range(2)])


def cause(name: str, size: float, scales):
    return CAUSES[name](places_of(name, scales), scales, np.random.default_rng(0), size)


def places_of(name: str, scales) -> str:
    return {"actuator": "motor", "body": "link", "world": "world"}.get(CAUSES[name].kind, "hinge")


def native(rig, edit=lambda model: None) -> np.ndarray:
    """The first log again in plain MuJoCo at the finer step, `[T]`."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.timestep /= FINER
    edit(model)
    data, take = mujoco.MjData(model), rig.takes[0]
    data.qpos[:], data.qvel[:] = take.qpos[0], take.qvel[0]
    out = []
    for u in take.ctrl:
        out.append(float(data.qpos[0]))
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=round(rig.period / model.opt.timestep))
    return np.array(out)


def moved(rig, *causes) -> np.ndarray:
    return rig.record(Plant(rig, {}, causes), 0, 0, noise=False).clean[:, 0]


def test_without_causes_it_is_the_model_at_a_finer_step(rig):
    assert rig.period == pytest.approx(0.02) and rig.base == "base" and rig.labels == ("fast", "slow")
    np.testing.assert_allclose(moved(rig), native(rig), atol=1e-9)


LATE = 0.013  # s, no multiple of a row's 20 ms


def _retimed(rig, how: str):
    """The rig with logs whose commands act otherwise than from row to row of a regular clock."""
    jitter = np.r_[0, np.random.default_rng(0).uniform(-0.004, 0.004, len(rig.takes[0].time) - 2), 0]
    changes = {"late": {"late": LATE}, "linear": {"linear": True}, "both": {"late": LATE, "linear": True}}
    own = [dataclasses.replace(t, **changes.get(how, {"time": t.time + jitter})) for t in rig.takes]
    return dataclasses.replace(rig, takes=tuple(own))


@pytest.mark.parametrize("how", ["late", "linear", "both", "jitter"])
def test_a_run_without_causes_has_no_strength_however_its_commands_act(rig, how):
    base = dict.fromkeys(base_names(rig.load().compile()), 1.0)
    ruler = Ruler(_retimed(rig, how), base, 0.15, 0)
    assert max(ruler.measure(ruler.runs)) < 1e-6


@pytest.mark.parametrize("how", ["late", "linear", "both"])
def test_commands_act_when_the_log_says(rig, how):
    model, take = mujoco.MjModel.from_xml_string(PENDULUM), _retimed(rig, how).takes[0]
    model.opt.timestep /= FINER
    data, h = mujoco.MjData(model), model.opt.timestep
    data.qpos[:], data.qvel[:] = take.qpos[0], take.qvel[0]
    rows = round(rig.period / h)
    for k in range(rows * (len(take.time) - 1)):
        t = (k + 0.5) * h - take.late
        held = take.ctrl[max(int(t // rig.period), 0), 0]
        data.ctrl[:] = np.interp(t, take.time, take.ctrl[:, 0]) if take.linear else held
        mujoco.mj_step(model, data)
    run = _retimed(rig, how).record(Plant(rig, {}), 0, 0, noise=False)
    assert run.clean[-1, 0] == pytest.approx(data.qpos[0], abs=1e-9)


def _damped(model):
    model.dof_damping[0] += 0.05


def _weak(model):
    model.actuator_gainprm[0, 0] *= 0.7


def _limited(model):
    model.actuator_forcelimited[0], model.actuator_forcerange[0] = 1, (-0.2, 0.2)


def _stuck(model):
    model.dof_frictionloss[0] = 0.05


def test_causes_are_mujocos_own_elements_where_it_has_them(rig, scales):
    np.testing.assert_allclose(moved(rig, cause("viscous_friction", 0.05, scales)), native(rig, _damped), atol=1e-9)
    weak, limited = cause("actuator_gain", 0.3, scales), cause("actuator_saturation", 0.0, scales)
    weak.sign, limited.size = -1.0, scales.effort["motor"] / 0.2 - 1
    np.testing.assert_allclose(moved(rig, weak), native(rig, _weak), atol=1e-9)
    np.testing.assert_allclose(moved(rig, limited), native(rig, _limited), atol=1e-9)
    # bristles bend before they slip, and MuJoCo's friction creeps: near, and far from none
    off = np.abs(moved(rig, cause("coulomb_friction", 0.05, scales)) - native(rig, _stuck)).max()
    assert off < 0.1 * np.abs(moved(rig) - native(rig, _stuck)).max()


def test_a_twin_with_the_true_parameters_closes_the_whole_gap(rig, scales):
    base = dict.fromkeys(base_names(rig.spec().compile()), 1.0)
    ruler = Ruler(rig, base, 0.15, 0)
    for name in ("coulomb_friction", "actuator_delay", "backlash"):
        hidden = cause(name, 0.1 * cause(name, 0.0, scales).largest, scales)
        numbers = {k: {"mean": v} for k, v in hidden.parameters().items()}
        (again,) = twin.twins(rig, scales, [{"name": name, "where": "all", "parameters": numbers}]) or []
        truth = Plant(rig, base, [hidden])
        assert twin.closed(ruler, truth, Plant(rig, base, [again])) == pytest.approx(1.0, abs=1e-6)
        assert twin.closed(ruler, truth, Plant(rig, base)) < 0.5


def test_every_twin_has_the_parameters_of_its_cause(rig, scales):
    for name in twin.WRITTEN:
        if (spots := places(rig, name, scales)) and name != "contact_friction":
            hidden = KNOWN[name](spots[0], scales, np.random.default_rng(3))
            hidden.size = max(0.3 * hidden.largest, hidden.smallest)
            Plant(rig, {}, [hidden])
            told = hidden.parameters()
            numbers = {k: {"mean": v} for k, v in told.items()}
            (again,) = twin.twins(rig, scales, [{"name": name, "where": spots[0], "parameters": numbers}]) or []
            Plant(rig, {}, [again])
            assert again.parameters() == pytest.approx(told), name


def test_noise_is_that_of_the_logs_and_encoder_steps_are_kept(rig):
    plain = Plant(rig, {})
    clean, run = rig.record(plain, 0, 0, noise=False), rig.record(plain, 0, 0)
    assert np.std(run.qpos - clean.qpos) == pytest.approx(4e-4, rel=0.4)
    steps = dataclasses.replace(rig, quantum=(1e-2,))
    levels = steps.record(plain, 0, 0).qpos / 1e-2
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-9)


def test_unnamed_elements_and_floating_bases_are_taken(tmp_path):
    text = PENDULUM.replace('name="hinge" ', "").replace('joint="hinge"', 'site="end"').replace(
        '</body></body>', '<site name="end"/></body></body>'
    )  # fmt: skip
    text = text.replace('<body name="base">', '<body name="base"><freejoint name="root"/>')
    (tmp_path / "model.xml").write_text(text)
    spec = load_model(tmp_path / "model.xml")
    assert [j.name for j in spec.joints] == ["root", "joint1"]
    model = spec.compile()
    assert "joint1.armature" in base_names(model) and "root.armature" not in base_names(model)


def test_masses_are_scaled_however_the_model_states_them():
    inertial = '<inertial pos="0 0 0" mass="2" diaginertia=".1 .1 .1"/><geom size=".1"/>'
    bodies = [inertial, '<geom size=".1"/>', '<geom size=".1" mass="2"/>']
    geoms_alone = '<compiler inertiafromgeom="true"/>'
    for compiler, body in [*(("", own) for own in bodies), (geoms_alone, inertial)]:
        text = f'<mujoco>{compiler}<worldbody><body name="b"><joint/>{body}</body></worldbody></mujoco>'
        plain, spec = mujoco.MjModel.from_xml_string(text), mujoco.MjSpec.from_string(text)
        scale_base(spec, {"b.mass": 1.3})
        scaled = spec.compile()
        assert scaled.body("b").mass[0] == pytest.approx(1.3 * plain.body("b").mass[0])
        np.testing.assert_allclose(scaled.body("b").inertia, 1.3 * plain.body("b").inertia)


def test_a_menu_is_proposed_within_the_models_limits_or_refused(tmp_path):
    (tmp_path / "model.xml").write_text(PENDULUM)
    menu = rig_of_menu(lambda: load_model(tmp_path / "model.xml"), "pendulum")
    run = menu.record(Plant(menu, {}), 0, 0, noise=False)
    assert np.ptp(run.clean) > 0.5 and np.abs(run.ctrl).max() <= 4
    (tmp_path / "model.xml").write_text(PENDULUM.replace(' ctrlrange="-4 4"', ""))
    with pytest.raises(UserError, match="ctrlrange"):
        rig_of_menu(lambda: load_model(tmp_path / "model.xml"), "pendulum")
