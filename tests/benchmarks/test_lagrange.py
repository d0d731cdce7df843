"""The arm that is written down without MuJoCo moves as MuJoCo C's does, and what is hidden in it changes that."""

import lagrange
import mujoco
import numpy as np
import pytest

STEPS = 60


def moved(arm, commands):
    """Angles [T, 2] of MuJoCo C's model of the arm, with its own numbers, under the same commands."""
    model = mujoco.MjModel.from_xml_string(lagrange.MODEL)
    model.opt.timestep, model.opt.integrator = 2e-4, mujoco.mjtIntegrator.mjINT_RK4
    load = arm.hidden.get("payload", 0.0)
    for k, body in enumerate(("upper", "lower")):
        i = model.body(body).id
        mass, own = arm.masses[k], load if body == "lower" else 0.0
        centre = (mass * arm.centres[k] + own * lagrange.TIP) / (mass + own)
        about = arm.inertias[k] + mass * (arm.centres[k] - centre) ** 2 + own * (lagrange.TIP - centre) ** 2
        model.body_mass[i], model.body_ipos[i], model.body_inertia[i] = (
            mass + own,
            [0, 0, -centre],
            [about, about, 1e-3],
        )
    model.dof_damping[:], model.dof_armature[:] = arm.damping, arm.rotors
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:] = 0.9 * WANTED[0, 0]
    out = []
    for command in commands:
        out.append(data.qpos.copy())
        data.ctrl[:] = command
        mujoco.mj_step(model, data, round(lagrange.PERIOD / model.opt.timestep))
    return np.array(out)


WANTED = lagrange.motion("multisine", np.random.default_rng(0))[None, :STEPS]


@pytest.mark.parametrize("cause", ["nothing", "payload", "inertial"])
def test_it_moves_as_mujocos_arm_does(cause):
    arm = lagrange.Arm.drawn(lagrange.CAUSES[cause], np.random.default_rng(1))
    angles, commands = lagrange.driven(arm, WANTED)
    np.testing.assert_allclose(angles[0], moved(arm, commands[0]), atol=lagrange.ENCODER)
    assert np.ptp(angles[0], axis=0).min() > 0.2


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("cause", [c for c in lagrange.CAUSES if c != "nothing"])
def test_every_cause_shows(cause):
    plain, other = (
        lagrange.driven(lagrange.Arm.drawn(lagrange.CAUSES[c], np.random.default_rng(1)), WANTED)[0]
        for c in ("nothing", cause)
    )
    assert np.abs(plain - other).max() > 4 * lagrange.ENCODER
