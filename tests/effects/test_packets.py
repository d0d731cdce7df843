"""Messages with random delays and losses: shares, means and order by hand; off and constant they are what they were."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import effects, registry
from bayessim_mjx.diagnosis.fitting.candidates import kinds_of
from bayessim_mjx.effects.support import packets
from bayessim_mjx.effects.support.reading import listed
from bayessim_mjx.errors import UserError

XML = """<mujoco><option timestep=".002"/><worldbody>
  <body><joint name="x" type="slide"/><geom size=".1" mass="1" contype="0"/></body>
  <body><joint name="y" type="slide"/><geom size=".1" mass="1" contype="0"/></body></worldbody>
  <actuator><motor name="a" joint="x"/><motor name="b" joint="y"/></actuator></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)
H, S = 0.002, 5  # s, timestep; of them in a control step
BOTH = ("a", "b")


@functools.cache
def program(effect, hook):
    """One compilation for all values, inputs of a length and seeds."""
    at = effect.bind(MODEL, H, S)

    def run(theta, rows, key):
        memory = effect.init(at)
        memory = memory | {"key": key} if "key" in memory else memory

        def step(memory, row):
            if hook == "on_command":
                return effect.on_command(at, memory, jnp.broadcast_to(row, (S, 2)), theta)
            memory, seen = effect.on_measurement(at, memory, {"qpos": row, "qvel": jnp.array([1.0, 2.0])}, theta)
            return memory, seen["qpos"]

        return jax.lax.scan(step, memory, rows)[1]

    return jax.jit(jax.vmap(run, in_axes=(None, None, 0)))


def drawn(effect, theta, rows, seeds, hook="on_command"):
    """`[seeds, T, ...]`."""
    keys = jnp.stack([jax.random.PRNGKey(seed) for seed in seeds])
    return np.asarray(program(effect, hook)(jnp.asarray(theta, jnp.float32), jnp.asarray(rows, jnp.float32), keys))


def obeyed(effect, theta, commands):
    """`[T, S, 2]` of the commands `[T, 2]`."""
    return drawn(effect, theta, commands, [0])[0]


def shown(effect, theta, motion):
    """Positions `[T, 2]` as the sensors show the true ones `[T, 2]`, whose speeds are 1 and 2."""
    return drawn(effect, theta, motion, [0], "on_measurement")[0]


def random_commands(steps):
    return np.random.default_rng(1).normal(size=(steps, 2)).astype(np.float32)


def ramp(steps):
    return np.arange(steps)[:, None] * H * S * np.array([1.0, 2.0]) + 3.0


@pytest.mark.parametrize("delay", [0.0, 0.0007, 0.003, 0.01, 0.0173, 0.02])
def test_without_jitter_and_loss_a_message_is_a_fixed_delay(delay):
    command, motion = random_commands(40), ramp(40)
    fixed = obeyed(effects.make("actuator_delay", where="all"), [delay], command)
    for law in packets.LAWS:
        own = obeyed(effects.make("command_packets", where="all", law=law), [delay, 0, 0], command)
        np.testing.assert_allclose(own, fixed, atol=2e-6)
    late = shown(effects.make("sensor_delay", where="all"), [delay], motion)
    np.testing.assert_allclose(
        shown(effects.make("sensor_packets", where="all"), [delay, 0, 0], motion), late, atol=1e-6
    )


def test_lost_commands_are_held_or_zero_in_their_share():
    command, loss = random_commands(4000), 0.3
    held = obeyed(effects.make("command_packets", where="all"), [0, 0, loss], command)
    zero = obeyed(effects.make("command_packets", where="all", lost="zero"), [0, 0, loss], command)
    gone = (held[:, 0] != command).any(1)
    assert np.mean(gone) == pytest.approx(loss, abs=3 * (loss * (1 - loss) / 4000) ** 0.5)
    rows = np.flatnonzero(gone[1:]) + 1
    assert np.array_equal(held[rows], np.repeat(held[rows - 1, -1:], S, 1))  # what it had
    assert np.array_equal((zero == 0).all((1, 2))[1:], gone[1:]) and not (zero[1:][~gone[1:]] == 0).any()


def test_one_bus_loses_for_all_drives_and_drives_of_their_own_lose_alone():
    command = random_commands(1000)
    tied = obeyed(effects.make("command_packets", where="all"), [0, 0, 0.3], command)[:, 0] != command
    alone = obeyed(effects.make("command_packets", where=BOTH), [0, 0, 0.3] * 2, command)[:, 0] != command
    assert np.array_equal(tied[:, 0], tied[:, 1])
    assert np.mean(alone.all(1)) == pytest.approx(0.09, abs=0.03)  # both by chance


@pytest.mark.parametrize("law", packets.LAWS)
def test_delays_have_the_mean_and_the_spread_that_are_stated(law):
    mean, jitter, count = 0.008, 0.003, 20000
    values = jnp.tile(jnp.array([[mean, jitter, 0.1]]), (count, 1))
    delay, gone = packets.draw(jax.random.PRNGKey(0), values, law)
    assert float(delay.mean()) == pytest.approx(mean, abs=4 * jitter / count**0.5)
    assert float(delay.std()) == pytest.approx(jitter, rel=0.03) and float(delay.min()) >= 0
    assert float(gone.mean()) == pytest.approx(0.1, abs=0.01)


def test_a_message_that_is_overtaken_has_no_effect():
    """Two-point law, 2 or 14 ms at steps of 10 ms: what is late arrives 2 ms after the next one, where that is not."""
    command = np.arange(1, 401, dtype=np.float32)[:, None] * np.ones(2, np.float32)
    out = obeyed(effects.make("command_packets", where="all", law="two_point"), [0.008, 0.006, 0], command)[:, :, 0]
    assert (np.diff(out.ravel()) >= 0).all()  # commands count up: nothing older ever comes back
    late = out[:, 3] < command[:, 0]  # 6 ms after it was sent
    overtaken = late[1:-2] & ~late[2:-1]
    assert 0.4 < late.mean() < 0.6 and overtaken.any()
    assert np.array_equal(np.isin(command[1:-2, 0], out), ~overtaken)


def test_the_mean_over_many_draws_is_the_mean_of_fixed_delays():
    """Linear: the expected command is that of `actuator_delay`, averaged over the two delays of the law."""
    command = random_commands(12)
    one, two = (obeyed(effects.make("actuator_delay", where="all"), [d], command) for d in (0.003, 0.009))
    effect = effects.make("command_packets", where="all", law="two_point")
    draws = drawn(effect, [0.006, 0.003, 0], command, range(400))
    away = np.abs(draws.mean(0) - (one + two) / 2)
    assert np.all(away <= 5 * draws.std(0) / 20 + 1e-5) and np.abs(one - two).max() > 0.5


def test_measurements_never_go_back_and_are_as_old_as_their_delay():
    motion = ramp(2000)
    seen = shown(effects.make("sensor_packets", where="all", law="uniform"), [0.008, 0.004, 0], motion)[50:, 0]
    age = motion[50:, 0] - seen  # speed 1
    assert (np.diff(seen) > -1e-5).all() and age.min() > 0.008 - 0.004 * 3**0.5 - 1e-4
    assert 0.006 < age.mean() < 0.0081  # a fresher one replaces what is late
    held = shown(effects.make("sensor_packets", where="all"), [0, 0, 0.25], motion)[1:, 0] != np.float32(motion[1:, 0])
    zero = shown(effects.make("sensor_packets", where="all", lost="zero"), [0, 0, 0.25], motion)[1:, 0] == 0
    assert np.array_equal(held, zero) and held.mean() == pytest.approx(0.25, abs=0.04)


def test_worlds_and_episodes_draw_by_their_own_keys():
    stack = [effects.make("command_packets", where="all"), effects.make("sensor_packets", where="all")]
    env = registry.make("Pendulum", effects=stack)
    theta = np.asarray(env.space.nominal)
    keys = [
        [np.asarray(m["key"]) for m in env.reset(jax.random.PRNGKey(seed), theta).pipeline_state.memory]
        for seed in (0, 1, 0)
    ]
    assert not np.array_equal(keys[0][0], keys[1][0]) and not np.array_equal(keys[0][0], keys[0][1])
    assert np.array_equal(keys[0], keys[2])


@pytest.mark.slow
@pytest.mark.ci
def test_a_task_randomises_them_and_off_they_change_no_bit():
    settings = {
        "command_packets": {"all": {"delay": {"range": [0, 0.01]}, "loss": {"range": [0, 0.2]}}},
        "sensor_packets": {"all": {"jitter": {"range": [0, 0.01]}, "loss": {"range": [0, 0.2]}}},
    }
    task = type(registry.make("Pendulum"))
    env, bare = (
        task(randomization={"randomization_params": section}) for section in ({"effects": settings}, {"effects": {}})
    )
    names = [f"all.{e}.{q}" for e in settings for q in ("delay", "jitter", "loss")]
    assert list(env.space.names) == names
    assert float(env.space.high[names.index("all.sensor_packets.loss")]) == pytest.approx(0.2)

    def run(env, theta):
        state, step = jax.jit(env.reset)(jax.random.PRNGKey(3), jnp.asarray(theta, jnp.float32)), jax.jit(env.step)
        out = []
        for k in range(30):
            state = step(state, jnp.array([np.sin(0.7 * k)]))
            out.append(np.asarray(state.obs["policy"]))
        return np.array(out)

    off, plain = run(env, np.zeros(6)), run(bare, np.zeros(0))
    assert np.array_equal(off, plain)
    assert np.abs(run(env, [0.005, 0.002, 0.1, 0.005, 0.002, 0.1]) - plain).max() > 1e-3


def test_a_diagnosis_neither_offers_nor_takes_what_is_random():
    assert not {"command_packets", "sensor_packets"} & {kind.name for kind in kinds_of("all")}
    with pytest.raises(UserError, match=r"command_packets: it is random.*logs check.*sent:command.*actuator_delay"):
        kinds_of(["all", "command_packets"])


def test_wrong_settings_are_refused():
    with pytest.raises(UserError, match="law = 'normal'; allowed: gamma, uniform, two_point"):
        effects.make("command_packets", where="all", law="normal")
    with pytest.raises(UserError, match="lost = 'drop'; allowed: hold, zero"):
        effects.make("sensor_packets", where="all", lost="drop")
    (far,) = listed([{"effect": "command_packets", "where": "all", "parameters": {"jitter": {"range": [0, 10]}}}])
    with pytest.raises(UserError, match="are 6003 control steps of 0.01 s; allowed: 256"):
        far.init(far.bind(MODEL, H, S))


def test_held_losses_are_late_by_their_odds_in_periods():
    """A command that counts up: the age of the one that is held is geometric, of mean p / (1 - p)."""
    command = np.arange(4000, dtype=np.float32)[:, None] * np.ones(2, np.float32)
    out = obeyed(effects.make("command_packets", where="all"), [0, 0, 0.2], command)
    assert np.mean(command[:, 0] - out[:, 0, 0]) == pytest.approx(0.25, abs=0.04)
