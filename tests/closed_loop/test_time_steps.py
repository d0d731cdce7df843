"""The simulators of a closed-loop study have time steps of their own, which their policies depend on."""

import dataclasses

import numpy as np
import pytest

from bayessim_mjx import gap_loop, registry
from bayessim_mjx.closed_loop import study
from bayessim_mjx.diagnosis.fitting.robot import of_task
from bayessim_mjx.diagnosis.summary import files
from tests.diagnosis.handwritten import diagnosis

SMALL = ["--iterations=8", "--episodes=16", "env.episodeLength=40", "ppo.num_envs=8", "--headless", "--device=cpu"]


def test_the_corrected_simulator_and_the_surrogate_have_time_steps_of_their_own(tmp_path):
    """And policies that were trained at another one are not taken up."""
    robot, found = of_task(registry.make("Pendulum")), diagnosis([("actuator_gain", "torque", {"gain": (0.6, 0.03)})])
    found.save(tmp_path)
    files.write_outputs(found, robot, tmp_path)

    def made(*more):
        given = ["--task", "Pendulum", "--diagnosis", str(tmp_path), "--surrogate", str(tmp_path / "effects.yaml")]
        args = gap_loop._parser().parse([*given, "--out", str(tmp_path / "out"), *more, *SMALL])
        return study.make(args, gap_loop._config(args))

    own = float(robot.mj_model.opt.timestep)
    plain, other = made(), made("--timestep", str(own / 2), "--surrogate_timestep", str(own / 5))
    steps = [
        [float(env.physics.mj_model.opt.timestep) for env in (s.nominal, s.corrected, s.real)]
        for s in (plain.simulators, other.simulators)
    ]
    np.testing.assert_allclose(steps, [[own, own, own], [own, own / 2, own / 5]], rtol=1e-6)
    prints = [{role: s.keeper.fingerprint(role, 0) for role in s.simulators.roles} for s in (plain, other)]
    same = {role: prints[0][role] == prints[1][role] for role in prints[0]}
    assert same == {"nominal": True, "corrected": False, "wide": True, "oracle": False}


@pytest.mark.parametrize(("error", "expected"), [(0.01, None), (0.03, 0.002)])
def test_a_step_that_errs_by_more_than_is_tolerated_is_replaced_by_the_diagnosis_own(error, expected):
    step = {"timestep": 0.008, "substep": 0.002, "physical": {"hinge": error, "other": 0.0}}
    found = diagnosis([("actuator_gain", "torque", {"gain": (0.6, 0.03)})])
    gap = dataclasses.replace(found.gap, integrator=step, physical={"hinge": {"tolerance": 0.02}})
    assert study.diagnosed_timestep(dataclasses.replace(found, gap=gap)) == expected
