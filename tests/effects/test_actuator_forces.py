"""Corrected actuators' forces: every kind of actuator, limit, gear and integrator, each on a mechanism of its own.

All mechanisms stand side by side in one model and all cases are worlds of one program, so an integrator costs one.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.compat import compiler_options
from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, control_step

TIMESTEP, CONTROL, STEPS, G = 0.005, 0.02, 12, 9.81
INTEGRATORS = pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
KINDS = {
    "motor": "<motor {}/>",
    "position": '<position kp="60" kv="30" {}/>',
    "velocity": '<velocity kv="25" {}/>',
    "general": '<general gaintype="affine" gainprm="12 2 -9" biastype="affine" biasprm="1 -20 -15" {}/>',
}
LIMITS = {"none": "", "ctrl": 'ctrlrange="-.3 .4"', "force": 'forcerange="-4 3"', "joint": "", "joint, too": ""}
RANGES = {"joint": "-5 4", "joint, too": "-7 8"}
COMPENSATED = 'actuatorgravcomp="true"'


def mechanisms():
    """(attributes of the body, attributes of its joint, its actuators), one mechanism each."""
    for kind, limit, gear in itertools.product(KINDS, LIMITS, (1.3, -0.9)):
        actuator = KINDS[kind].format(f'joint="{{0}}" gear="{gear}" {LIMITS[limit]}')
        yield "", f'actuatorfrcrange="{RANGES[limit]}"' if limit in RANGES else "", [actuator]
    two = [
        KINDS[k].format('joint="{0}" ' + more) for k, more in (("motor", 'gear="-1"'), ("position", LIMITS["force"]))
    ]
    yield "", "", two
    yield "", 'actuatorfrcrange="-6 6"', two
    for kind in ("motor", "position"):
        alone = [KINDS[kind].format('joint="{0}" gear="-1.1"')]
        yield 'gravcomp="1"', COMPENSATED, alone
        yield 'gravcomp="1"', f'{COMPENSATED} actuatorfrcrange="-12 11"', alone
    yield 'gravcomp="1"', COMPENSATED, two
    yield 'gravcomp="1"', COMPENSATED, two[::-1]
    yield (
        "",
        "",
        ['<general joint="{0}" dyntype="filter" dynprm=".03" gainprm="9" biastype="affine" biasprm="0 -9 -8"/>'],
    )


def xml(integrator):
    bodies, actuators = [], []
    for i, (body, joint, own) in enumerate(mechanisms()):
        slide = f'<joint name="j{i}" type="slide" axis="0 0 1" {joint}/>'
        bodies.append(
            f'<body pos="{i} 0 0" {body}>{slide}<geom size=".1" mass="1" contype="0" conaffinity="0"/></body>'
        )
        actuators += [a.format(f"j{i}").replace("/>", f' name="a{i}_{k}"/>') for k, a in enumerate(own)]
    option = f'<option timestep="{TIMESTEP}" gravity="0 0 -{G}" integrator="{integrator}"/>'
    return f"""<mujoco>{option}<worldbody>{"".join(bodies)}</worldbody>
        <actuator>{"".join(actuators)}</actuator></mujoco>"""


MODEL = mujoco.MjModel.from_xml_string(xml("Euler"))
TIME = CONTROL * np.arange(STEPS)[:, None]
COMMAND = (0.9 * np.sin(17 * TIME + np.arange(MODEL.nu)) + 0.2).astype(np.float32)
START = 0.3 * np.cos(np.arange(MODEL.nv)), 0.5 * np.sin(1.7 * np.arange(MODEL.nv))
MOTORS = np.array([KINDS["motor"][:6] in a for *_, own in mechanisms() for a in own])
COMMAND[:, MOTORS] *= 8.0  # a motor's command is its force

NATIVE = {
    "gain below": ("actuator_gain", [0.8]),
    "gain above": ("actuator_gain", [1.5]),
    "bias": ("actuator_bias", [0.7]),
    "saturation": ("actuator_saturation", [1 / 2.5]),
}
OTHERS = {
    "dead band": ("actuator_deadband", [0.25]),
    "loss": ("effort_loss", [0.15]),
    "speed": ("speed_torque_limit", [1 / 6, 1 / 3]),
}
EFFECTS = tuple(dict.fromkeys(name for name, _ in (*NATIVE.values(), *OTHERS.values())))
ON = np.ones(MODEL.nu)
SOME = np.arange(MODEL.nu) % 3 > 0
CASES = {
    "neutral": ("", []),
    "off": ("", []),
    "off, biased": ("actuator_bias", [0.7]),
    "some": ("actuator_gain", [0.8]),
}
CASES |= NATIVE | OTHERS
ENABLED = {"off": 0 * ON, "off, biased": 0 * ON, "some": SOME}


@functools.cache
def physics(integrator):
    model = mujoco.MjModel.from_xml_string(xml(integrator))
    fixed = tuple(model.actuator(i).name for i in np.flatnonzero(model.actuator_gaintype == 0))
    places = {name: fixed if name == "actuator_deadband" else "all" for name in EFFECTS}
    return Physics(model, CONTROL, ParameterSpace(), [make(name, where=where) for name, where in places.items()])


@functools.cache
def motions(integrator):
    """{case: (qpos, qvel) `[STEPS, nv]`}, all cases at once."""
    p, thetas = physics(integrator), []
    for name, values in CASES.values():
        theta = np.array(p.space.nominal)
        own = [i for i, label in enumerate(p.space.names) if f".{name}." in label]
        theta[own] = np.resize(values, len(own)) if own else 0.0
        thetas.append(theta)

    def one(theta, enabled):
        def step(world, command):
            world, _ = control_step(p, world, command, Drive(enabled=enabled))
            return world, (world.qpos, world.qvel)

        return jax.lax.scan(step, p.world(theta, *START), jnp.asarray(COMMAND))[1]

    enabled = np.stack([ENABLED.get(case, ON) for case in CASES])
    qpos, qvel = jax.jit(jax.vmap(one))(np.float32(thetas), np.float32(enabled))
    return {case: (np.asarray(qpos[i]), np.asarray(qvel[i])) for i, case in enumerate(CASES)}


def by_mujoco(integrator, case):
    """The same by MuJoCo C, the effect written into the model."""
    spec = mujoco.MjSpec.from_string(xml(integrator))
    if case in NATIVE:
        name, values = NATIVE[case]
        effect = make(name, where="all")
        own = {"all": dict(zip([q.name for q in effect.quantities], values, strict=True))}
        assert effect.edit(spec, own) is None
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = START
    for command in COMMAND:
        data.ctrl[:] = command
        mujoco.mj_step(model, data, round(CONTROL / TIMESTEP))
        rows.append((data.qpos.copy(), data.qvel.copy()))
    return tuple(np.array(x) for x in zip(*rows, strict=True))


def agree(got, want, atol=1e-5):
    for one, two in zip(got, want, strict=True):
        np.testing.assert_allclose(one, two, atol=atol * (1 + np.abs(two).max()))


@INTEGRATORS
@pytest.mark.parametrize("case", ["neutral", *NATIVE])
def test_an_effect_is_its_own_edit_recompiled_in_mujoco(integrator, case):
    got = motions(integrator)[case]
    agree(got, by_mujoco(integrator, case))
    if case != "neutral":
        assert np.abs(got[1] - motions(integrator)["neutral"][1]).max(axis=0).mean() > 0.05


@INTEGRATORS
@pytest.mark.parametrize("case", ["off", "off, biased"])
def test_a_robot_whose_drives_are_off_falls_freely(integrator, case):
    qpos, qvel = motions(integrator)[case]
    time = CONTROL * np.arange(1, STEPS + 1)[:, None]
    late = 0.0 if integrator == "RK4" else TIMESTEP  # semi-implicit: velocities act a step early
    agree((qpos, qvel), (START[0] + START[1] * time - G / 2 * time * (time + late), START[1] - G * time))


def dead_band(asked, error, speed, h):
    return asked - np.clip(error, -h * np.abs(MODEL.actuator_gainprm[:, 0]), h * np.abs(MODEL.actuator_gainprm[:, 0]))


def loss(force, error, speed, a):
    return force / (1 + a * np.abs(force))


def speed_limit(force, error, speed, stall, fast):
    most = np.where(force * speed > 0, np.maximum(1 - fast * np.abs(speed), 0), 1) / stall
    return np.clip(force, -most, most)


LAWS = {"dead band": dead_band, "loss": loss, "speed": speed_limit, "some": lambda f, e, w, gain: gain * f}


def limited(limited, bounds, x):
    return np.where(limited, np.clip(x, *bounds.T), x)


class Reference:
    """The mechanisms in plain NumPy: unit masses on slides, each integrator in its textbook form."""

    def __init__(self, case):
        self.case, self.values = case, CASES[case][1]
        self.gear, self.joint = MODEL.actuator_gear[:, 0], MODEL.actuator_trnid[:, 0]
        self.affine = MODEL.actuator_gaintype == 1
        self.slow = np.flatnonzero(MODEL.actuator_dyntype)

    def damping(self, signal):
        return MODEL.actuator_biasprm[:, 2] + self.affine * MODEL.actuator_gainprm[:, 2] * signal

    def signal(self, ctrl, act):
        signal = limited(MODEL.actuator_ctrllimited, MODEL.actuator_ctrlrange, ctrl)
        signal[self.slow] = act
        return signal

    def acting(self, q, v, signal, more=0.0):
        """Actuators' forces; `more` is added to what their damping asks for."""
        length, speed = self.gear * q[self.joint], self.gear * v[self.joint]
        gain, bias = MODEL.actuator_gainprm.T, MODEL.actuator_biasprm.T
        asked = (gain[0] + self.affine * (gain[1] * length + gain[2] * speed)) * signal
        asked = asked + bias[0] + bias[1] * length + bias[2] * speed + more
        error, law = gain[0] * signal + bias[1] * length, LAWS[self.case]
        clip = functools.partial(limited, MODEL.actuator_forcelimited, MODEL.actuator_forcerange)
        if self.case == "dead band":
            return clip(np.where(self.affine, asked, law(asked, error, speed, *self.values)))
        return law(clip(asked), error, speed, *self.values) * ENABLED.get(self.case, ON)

    def torque(self, acting):
        """(what the joints get, whether they are below their limits)."""
        powered = np.bincount(self.joint, ENABLED.get(self.case, ON), MODEL.nv) > 0
        torque = np.bincount(self.joint, self.gear * acting, MODEL.nv) + G * MODEL.body_gravcomp[1:] * powered
        clipped = limited(MODEL.jnt_actfrclimited, MODEL.jnt_actfrcrange, torque)
        return clipped, clipped == torque

    def slopes(self, q, v, act, ctrl, dt=0.0):
        """Derivatives of the state; dt > 0: with damping at the end of the step."""
        signal = self.signal(ctrl, act)
        acting = self.acting(q, v, signal)
        torque, inside = self.torque(acting)
        passed = (self.acting(q, v, signal, 1e-7) - acting) / 1e-7
        matrix = np.bincount(self.joint, self.gear**2 * passed * self.damping(signal) * inside[self.joint], MODEL.nv)
        return v, (torque - G) / (1 - dt * matrix), (ctrl[self.slow] - act) / MODEL.actuator_dynprm[self.slow, 0]

    def step(self, integrator, state, ctrl):
        q, v, act = state
        if integrator != "RK4":
            _, acceleration, rate = self.slopes(*state, ctrl, TIMESTEP if integrator == "implicitfast" else 0.0)
            v = v + TIMESTEP * acceleration
            return q + TIMESTEP * v, v, act + TIMESTEP * rate
        slopes = [self.slopes(*state, ctrl)]
        for part in (0.5, 0.5, 1.0):
            there = (x + part * TIMESTEP * k for x, k in zip(state, slopes[-1], strict=True))
            slopes.append(self.slopes(*there, ctrl))
        sums = [k1 + 2 * k2 + 2 * k3 + k4 for k1, k2, k3, k4 in zip(*slopes, strict=True)]
        return tuple(x + TIMESTEP / 6 * k for x, k in zip(state, sums, strict=True))

    def motion(self, integrator):
        state, rows = (*START, np.zeros(len(self.slow))), []
        for command in COMMAND.astype(float):
            for _ in range(round(CONTROL / TIMESTEP)):
                state = self.step(integrator, state, command)
            rows.append(state[:2])
        return tuple(np.array(x) for x in zip(*rows, strict=True))


def test_some_joint_is_compensated_by_one_of_two_drives_that_is_off():
    compensated = MODEL.jnt_actgravcomp[MODEL.actuator_trnid[:, 0]] > 0
    drives = np.bincount(MODEL.actuator_trnid[compensated, 0], SOME[compensated], MODEL.nv)
    assert set(drives[np.bincount(MODEL.actuator_trnid[compensated, 0], minlength=MODEL.nv) == 2]) == {1.0}


@INTEGRATORS
@pytest.mark.parametrize("case", LAWS)
def test_laws_that_mujoco_lacks_follow_their_equations(integrator, case):
    """Also where some drives are off, on joints with two actuators, behind gravity compensation and limits."""
    got = motions(integrator)[case]
    agree(got, Reference(case).motion(integrator))
    assert np.abs(got[1] - motions(integrator)["neutral"][1]).max(axis=0).mean() > 0.05


@pytest.mark.slow
@INTEGRATORS
def test_neutral_changes_no_bit(integrator):
    """With all effects in the program and all drives on; behind limits, gears and gravity compensation."""
    bare = Physics(physics(integrator).mj_model, CONTROL, ParameterSpace())

    def motion(p, drive):
        def run(theta, drive):
            def step(world, command):
                world, _ = control_step(p, world, command, drive)
                return world, (world.qpos, world.qvel)

            return jax.lax.scan(step, p.world(theta, *START), jnp.asarray(COMMAND))[1]

        options = compiler_options(fused=True)  # bit for bit is a matter of the compiler as users have it
        return jax.jit(run, compiler_options=options)(np.float32(p.space.nominal), drive)

    with_all = motion(physics(integrator), Drive(enabled=np.float32(ON)))
    for one, two in zip(motion(bare, Drive()), with_all, strict=True):
        assert np.array_equal(one, two)
