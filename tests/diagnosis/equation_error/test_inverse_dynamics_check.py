"""What logs of an arm from MuJoCo C say before any simulation: the load, the weak motor, what each contradicts."""

import copy
import dataclasses

import pytest
import rigs

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check, lead, proposed
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.fitting.candidates import enumerate_candidates
from bayessim_mjx.diagnosis.phrases import notes
from bayessim_mjx.effects import load as effect

LOAD = rigs.Truth("payload", "tool", (1.0, 0.05, 0.0, 0.02))
WEAK = rigs.Truth("actuator_gain", "elbow_motor", (0.8,))
FEW = ("payload", "actuator_gain", "actuator_saturation")


def recorded(truth, system="arm_torque", **how):
    how = {"period": 0.01, "sigma": 3e-4, "quantum": 0.0, "effort": True, "seed": 3, "runs": 3, "seconds": 3.0} | how
    return rigs.record(rigs.Rig(system, truth, **how))


@pytest.fixture(scope="module")
def loaded():
    model, logs = recorded(LOAD)
    return check(logs, model)


@pytest.fixture(scope="module")
def weak():
    model, logs = recorded(WEAK)
    return model, check(logs, model)


@pytest.mark.slow
@pytest.mark.ci
def test_a_load_is_found_where_it_is(loaded):
    (found,) = loaded.proposals
    assert found.label == "payload@tool" and loaded.explained > 0.95 and loaded.seconds < 30
    assert found.parameters["mass"] == pytest.approx(1.0, rel=0.1)
    assert [found.parameters[f"com_{a}"] for a in "xyz"] == pytest.approx(LOAD.values[1:], abs=0.015)
    assert {j.source for j in loaded.joints} == {"effort"} and all(c.sound for c in loaded.channels)


def test_motors_that_obey_and_a_heavier_mechanism_are_told_apart(loaded, weak):
    assert notes.first_verdict(loaded) == (
        "the motors follow their commands, but the mechanism is heavier or stiffer than the model"
    )
    assert notes.first_verdict(weak[1]) == (
        "the motors do not follow their commands, but the mechanism moves as the model predicts"
    )
    assert any("extra payload at tool: mass" in line for line in notes.first_look(loaded))
    assert any("elbow_motor 0.80 of it" in line for line in notes.first_look(weak[1]))


@pytest.mark.slow
@pytest.mark.ci
def test_a_weak_motor_is_found_with_and_without_measured_effort(weak):
    _, seen = weak
    assert not seen.proposals and proposed(seen)["actuator_gain@elbow_motor"]["gain"] == pytest.approx(0.8, abs=0.02)
    model, logs = recorded(WEAK, effort=False)
    blind = check(logs, model)
    assert proposed(blind)["actuator_gain@elbow_motor"]["gain"] == pytest.approx(0.8, abs=0.03)
    assert "actuator_gain@all" in blind.vetoes  # the others are not weak
    assert notes.first_verdict(blind) == ""


def test_leads_start_and_veto_candidates(weak, tmp_path):
    model, seen = weak
    physics = robot.robot_of(model).physics(0.01, [effect(n)(where=places(model, n)) for n in FEW])
    every = enumerate_candidates(physics)
    found = lead(every, seen)
    left = {c.label for c in found.candidates}
    assert "actuator_gain@elbow_motor" in left and "actuator_saturation@waist_motor" not in left
    assert set(found.vetoed) == {c.label for c in every} - left
    (own,) = [c for c in found.candidates if c.label == "actuator_gain@elbow_motor"]
    assert own.probes[-1] == pytest.approx([0.8], abs=0.02)


def places(model, name):
    kind = effect(name).kind
    count = {"actuator": model.nu, "body": model.nbody}[kind]
    return tuple(getattr(model, kind)(i).name for i in range(count) if kind != "body" or model.body_weldid[i] == i > 0)


@pytest.mark.slow
def test_efforts_in_a_unit_of_their_own_are_told(loaded):
    model, logs = recorded(rigs.Truth())
    half = [
        dataclasses.replace(log, streams={k: 0.5 * s for k, s in log.streams.items()}, metadata=log.metadata)
        for log in logs
    ]
    seen = check(half, model)
    assert seen.unit == pytest.approx(2.0, rel=0.05) and not seen.proposals and not seen.vetoes
    assert all(c.scale == pytest.approx(1.0, abs=0.02) for c in seen.channels)
    stated = [dataclasses.replace(log, metadata={**log.metadata, "effort_unit": "N m"}) for log in half]
    assert check(stated, model).unit == 1.0


def test_nothing_to_look_at_is_no_error(loaded):
    model, logs = recorded(rigs.Truth(), runs=1, seconds=0.5)
    still = dataclasses.replace(logs[0], qpos=0 * logs[0].qpos, qvel=0 * logs[0].qvel)
    assert check([still], model).joints == ()
    assert "no joint" in notes.first_look(check([still], model))[0]


def test_a_drive_that_is_heavier_and_stiffer_than_modelled_is_no_weak_motor():
    """Rotor inertia, damping and friction that a model leaves out look like a gain: one number for three."""
    truth = rigs.Truth("coulomb_friction", "each", (0.6, 0.3))
    model, logs = recorded(truth, system="two_link", effort=False, runs=6)
    guessed = copy.copy(model)
    guessed.dof_armature[:] = model.dof_armature / 4
    guessed.dof_damping[:] = model.dof_damping / 3
    seen = check(logs, guessed)
    found = proposed(seen)
    assert not any(label.startswith("actuator_gain") for label in found)
    for v, joint in enumerate(("shoulder", "elbow")):
        assert found[f"coulomb_friction@{joint}"]["level"] == pytest.approx(truth.values[v], rel=0.1)
        added = 0.75 * model.dof_armature[v]
        assert found[f"armature@{joint}"]["inertia"] == pytest.approx(added, rel=0.25)
