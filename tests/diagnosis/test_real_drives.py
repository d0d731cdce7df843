"""A cable hidden in MuJoCo C's motion is named with its numbers."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.summary import assemble

from .missing_forces import STEP, arm, record

pytestmark = pytest.mark.slow  # whole diagnoses

PULLING = ("joint_spring", "payload", "gravity_tilt", "coulomb_friction", "cable_tension")


def cable(t, data):
    return np.array([-2.0 * max(float(data.qpos[0]) - 0.25, 0.0)])


def diagnosed(force, effects):
    needed = [s for s in run.STAGES if not s.optional]
    found = run.investigate(robot.robot_of(arm(1, STEP)), record(force=force, logs=6), Request(effects), stages=needed)
    return assemble.diagnosis_of(found)


def test_a_cable_is_named_beside_a_spring():
    diagnosis = diagnosed(cable, PULLING)
    (effect,) = diagnosis.effects
    assert (diagnosis.verdict, effect.name, effect.where) == ("effects", "cable_tension", "shoulder")
    assert effect.parameters["forward"].mean == pytest.approx(2.0, rel=0.1)
    assert effect.parameters["taut"].mean == pytest.approx(0.25, abs=0.03)
