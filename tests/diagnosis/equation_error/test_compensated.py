"""What a model does without its drives, compensation of gravity and dry friction, is nothing that it lacks."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check
from bayessim_mjx.diagnosis.logcheck import gate
from tests.diagnosis.recordings import ARM, record

COMPENSATED = ARM.replace("<body", '<body gravcomp="1"')
MODELS = {
    "compensated": COMPENSATED,
    "compensated by the drives": COMPENSATED.replace("<joint", '<joint actuatorgravcomp="true"'),
    "half compensated": ARM.replace("<body", '<body gravcomp=".5"'),
    "dry friction": ARM.replace("<joint", '<joint frictionloss="0.3"'),
    "both": COMPENSATED.replace("<joint", '<joint frictionloss="0.3"'),
}


def follow(seed: int):
    """Torques that follow sines, one of another pace for each joint, from rest on."""

    def law(t: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        goal = min(t / 2, 1.0) * np.array([0.8, 1.0]) * np.sin(np.array([2.3, 3.7]) * t + seed)
        return np.array([20.0, 5.0]) * (goal - qpos) - np.array([2.0, 0.4]) * qvel

    return law


@pytest.mark.parametrize("name", MODELS)
def test_nothing_is_missing_where_nothing_is_hidden(name: str):
    xml = MODELS[name]
    model = mujoco.MjModel.from_xml_string(xml)
    logs = [record(xml, follow(k), sigma=5e-5, name=f"{k}.npz", seed=k) for k in (0, 1)]
    seen = check(logs, model)
    assert not seen.proposals and all(j.nominal < 0.05 and j.source == "ctrl" for j in seen.joints), seen.joints
    found = gate.check(logs, model, 0.01)
    assert len(found.usable) == 2 and not found.warnings
    assert all((r.explained or 0.0) > 0.95 for report in found.reports for r in report.relations)


def test_a_load_on_a_compensated_arm_is_a_payload():
    """What carries the arm's weight carries no body that was added: its weight is on the drives."""
    spec = mujoco.MjSpec.from_string(COMPENSATED)
    place = mujoco.MjModel.from_xml_string(COMPENSATED).body_ipos[-1]
    load = spec.bodies[-1].add_body(pos=place, mass=0.3, inertia=np.full(3, 1e-8), ipos=np.zeros(3))
    load.explicitinertial = True
    logs = [record(spec.to_xml(), follow(k), sigma=5e-5, name=f"{k}.npz", seed=k) for k in (0, 1)]
    seen = check(logs, mujoco.MjModel.from_xml_string(COMPENSATED))
    (found,) = seen.proposals
    assert found.term.effect == "payload" and seen.explained > 0.95
    assert found.parameters["mass"] == pytest.approx(0.3, rel=0.05)
