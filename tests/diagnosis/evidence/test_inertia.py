"""A law of inertia in the place of another begins where all bodies have the same inertia."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence.laws import with_same_inertia
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.fitting.candidates import base_coordinates, enumerate_candidates
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.effects import make
from bayessim_mjx.physics import Physics

XML = """
<mujoco><option timestep="0.01"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom type="box" size=".02 .03 .1" pos="0 0 -.1" mass="2"/>
    <body name="lower" pos="0 0 -.2"><joint name="elbow" axis="0 1 0"/>
      <geom type="box" size=".02 .03 .1" pos="0 0 -.1" mass="1"/></body></body>
</worldbody></mujoco>
"""
LOAD, ARM = 0.1, np.array([0.02, -0.03, -0.08])


class Windows:
    sigma_q = sigma_v = np.ones(2)
    spread, measured, steps = np.ones(4), np.ones(1), 1

    def __len__(self):
        return 1


def fitter():
    model = mujoco.MjModel.from_xml_string(XML)
    space = robot.default_space(model)
    physics = Physics(model, 0.02, space, [make("payload", "lower"), make("inertial_parameters", "lower")])
    return Fitter(
        SimpleNamespace(physics=physics, windows=Windows(), starts=4), base_coordinates(space), physics.neutral
    )


def model_of(at, law, known, own):
    coordinates = (*at.base, *law.coordinates)
    values = np.array([known.get(c.name, c.neutral) for c in at.base] + list(own))
    return SimpleNamespace(fit=SimpleNamespace(coordinates=coordinates, values=values), effects=(law,))


def test_a_payload_and_what_it_does_to_its_body():
    at = fitter()
    laws = {c.effect: c for c in enumerate_candidates(at.simulator.physics)}
    load, body = laws["payload"], laws["inertial_parameters"]
    names = [c.name for c in at.base]
    found = with_same_inertia(at, model_of(at, load, {"lower_mass_mult": 1.1}, [LOAD, *ARM]), load, body)
    assert found.known[names.index("lower_mass_mult")] == pytest.approx(1.1 + LOAD, rel=0.02)
    assert found.known[names.index("upper_mass_mult")] == 1.0
    assert found.own[:3] == pytest.approx(LOAD / (1.1 + LOAD) * ARM, abs=0.002)

    back = with_same_inertia(
        at, model_of(at, body, {"lower_mass_mult": 1.1 + LOAD}, [*(LOAD / 1.2 * ARM), 1.0]), body, load
    )
    mass = back.known[names.index("lower_mass_mult")]
    assert mass + back.own[0] == pytest.approx(1.2, rel=0.02)
    assert back.own[0] * back.own[1:] == pytest.approx(LOAD * ARM, abs=0.002)
