"""A plant whose motion is not MuJoCo's: `own_motion`'s equations in Runge-Kutta steps of .1 ms."""

from collections.abc import Sequence

import jax
import numpy as np
import own_motion
import own_robot

from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.plant import Plant, Rig

STEP = 1e-4  # s


class OwnPlant(Plant):
    """A robot with causes that moves by equations of its own; a cause that acts in steps acts once in each of them.

    MuJoCo compiles the model, and its data carry states and forces to causes and experimenter.

    Raises:
        ValueError: the robot has something that these equations lack.
    """

    def __init__(self, system: Rig, base: dict[str, float], causes: Sequence[Cause] = ()) -> None:
        super().__init__(system, base, causes)
        self.steps = round(system.period / STEP)
        self.timestep = self.model.opt.timestep = system.period / self.steps
        self.robot = own_robot.robot(self.model)
        self.program = own_motion.program(self.robot)
        self.filtered = np.flatnonzero(self.model.actuator_actadr >= 0)

    def move(self, count: int) -> None:
        model, data, n, nu = self.model, self.data, self.model.nv, self.model.nu
        act = np.zeros(nu)
        act[self.filtered] = data.act
        gain, bias, ends = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3], model.actuator_forcerange.T
        # a bias is what the model's type of it says: of actuators without one it is not read
        bias = np.where(model.actuator_biastype[:, None] == 0, 0.0, bias)
        held = (data.ctrl, gain, bias.ravel(), *ends, data.qfrc_applied, data.xfrc_applied[self.robot.bodies].ravel())
        with jax.enable_x64(True):
            state = np.concatenate([data.qpos, data.qvel, act])
            out = np.asarray(self.program(state, np.concatenate(held), self.timestep, count))
        data.qpos[:], data.qvel[:], act = np.split(out[: 2 * n + nu], (n, 2 * n))
        data.act[:] = act[self.filtered]
        data.actuator_force[:], data.qfrc_actuator[:], data.qfrc_bias[:] = np.split(out[2 * n + nu :], (nu, nu + n))
        data.time += count * self.timestep
