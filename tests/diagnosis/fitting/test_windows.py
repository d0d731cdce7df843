"""Logs cut into windows: shapes, operating conditions, commands centred on their sub-step, padding, noise."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log
from tests.diagnosis.pendulums import ARMATURE, DAMPING, MASS, MODEL, PERIOD, STEP, recorded

SUBSTEPS, LENGTH = 10, 25
LOGS = recorded(count=3, seconds=2.0)


def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL % (STEP, "Euler", DAMPING, ARMATURE, 0.0, MASS))


def cut(logs, length=LENGTH, limit=99, **more) -> windows.Windows:
    return windows.cut(logs, model(), PERIOD, SUBSTEPS, length, limit=limit, **more)


def with_command(ctrl: np.ndarray) -> Log:
    return dataclasses.replace(LOGS[0], ctrl=ctrl[:, None])


def test_shapes_and_what_each_window_holds():
    found = cut(LOGS)
    per_log = (len(LOGS[0]) - 1) // LENGTH
    assert per_log == 4 and len(found) == 3 * per_log and found.steps == LENGTH
    assert found.batch.command.shape == (12, LENGTH, SUBSTEPS, 1)
    assert found.batch.qpos.shape == found.batch.qvel.shape == (12, LENGTH, 1)
    assert found.spread.shape == (2,) and found.batch.enabled is None and found.batch.law is None
    for w in range(len(found)):
        log, a = LOGS[found.log[w]], found.start[w]
        np.testing.assert_allclose(found.batch.qpos[w], log.qpos[a + 1 : a + 1 + LENGTH], rtol=1e-6)
        np.testing.assert_allclose(found.batch.around.qpos[w, found.batch.around.start], log.qpos[a], rtol=1e-6)


def test_few_windows_are_spread_over_all_logs():
    found = cut(LOGS, limit=6)
    assert len(found) == 6 and set(found.log) == {0, 1, 2}


def test_logs_that_are_too_short_are_refused():
    with pytest.raises(UserError, match="no log holds 500 control steps.*longest has 100"):
        cut(LOGS, length=500)
    assert set(cut([LOGS[0].cut(0, 10), LOGS[1]]).log) == {1}


def test_operating_conditions():
    def labelled(**keys):
        return [dataclasses.replace(log, metadata={k: v[i] for k, v in keys.items()}) for i, log in enumerate(LOGS)]

    assert windows.groups_of(LOGS) == ([0, 1, 2], ("log0", "log1", "log2"))
    assert windows.groups_of(labelled(condition=["cold", "warm", "cold"])) == ([0, 1, 0], ("cold", "warm"))
    both = labelled(condition=["cold", "warm", "cold"], load=[1, 1, 2])
    assert windows.groups_of(both, "load") == ([0, 0, 1], ("1", "2"))
    found = cut(both, group="load")
    assert found.groups == ("1", "2") and all((found.log == 2) == (found.group == 1))
    assert not found.notes
    with pytest.raises(UserError, match="--group speed: no log.*condition, load"):
        windows.groups_of(both, "speed")
    with pytest.raises(UserError, match="--group speed.*no keys"):
        windows.groups_of(LOGS, "speed")


def test_a_group_that_holds_nothing_out_is_told():
    def loaded(*values):
        return [
            dataclasses.replace(log, metadata={} if v is None else {"load": v})
            for log, v in zip(LOGS, values, strict=True)
        ]

    same = cut(loaded(1, 1, 1), group="load")
    assert same.groups == ("log0", "log1", "log2")
    assert same.notes == ("--group load: '1' in all logs, so nothing can be held out by it; single logs are held out",)
    partly = cut(loaded(1, 2, None), group="load")
    assert partly.groups == ("1", "2", "log2") and "log2 without this key" in partly.notes[0]
    (alone,) = cut(loaded(1, 1, 1)[:1], group="load").notes
    assert "blocks of the only log in time" in alone


def test_one_log_is_held_out_in_blocks_of_time():
    found = cut(recorded(count=1, seconds=5.0))
    assert found.groups == tuple(f"part {i} of 5" for i in range(1, 6))
    assert np.all(np.diff(found.group) >= 0) and set(found.group) == set(range(5))
    assert found.blocks and found.conditions == 1 and not found.condition.any()
    several = cut(LOGS)
    assert not several.blocks and several.conditions == 3 and (several.condition == several.group).all()


def test_pieces_of_one_file_are_one_log():
    """A file that was cut at a gap is no second operating condition."""
    one, two, other = (
        dataclasses.replace(log, name=name, metadata={"source": f"logs/{name.partition('#')[0]}"})
        for log, name in zip(LOGS, ("a.csv#0", "a.csv#1", "b.csv"), strict=True)
    )
    assert windows.groups_of([one, two, other]) == ([0, 0, 1], ("a.csv", "b.csv"))
    alone = cut([one, two])
    assert alone.blocks and alone.conditions == 1 and alone.groups[0].startswith("part 1 of")


def test_a_step_of_the_command_acts_half_a_substep_before_its_row():
    rows = len(LOGS[0])
    found = cut([with_command(np.where(np.arange(rows) >= 10, 2.0, 0.0))])
    command = np.asarray(found.batch.command[0, :, :, 0])
    expected = np.zeros((LENGTH, SUBSTEPS))
    expected[10:] = 2.0
    expected[10, 0] = 1.0  # the mean over half a sub-step before and after the row's time
    np.testing.assert_allclose(command, expected, atol=1e-5)


def test_a_linear_command_is_its_value_where_the_force_acts():
    """Its mean over the sub-step centred on that time; held, it would be the last row's."""
    time, ramp = LOGS[0].time, dataclasses.replace(with_command(5.0 * LOGS[0].time), metadata={"hold": "linear"})
    command = np.asarray(cut([ramp]).batch.command[1, :, :, 0])
    at = time[LENGTH] + PERIOD / SUBSTEPS * np.arange(LENGTH * SUBSTEPS)
    np.testing.assert_allclose(command.ravel(), 5.0 * at, rtol=1e-5)


def test_impulses_of_commands_survive_fast_logs():
    fast = 5  # rows of the log per control step
    rng = np.random.default_rng(0)
    time = PERIOD / fast * np.arange(60 * fast + 1, dtype=np.float64)
    ctrl = rng.normal(size=(len(time), 1))
    qpos = np.sin(time)[:, None]
    raw = dataclasses.replace(LOGS[0], time=time, ctrl=ctrl, qpos=qpos, qvel=np.cos(time)[:, None])
    found = cut([raw])
    command = np.asarray(found.batch.command[..., 0], float).reshape(len(found), -1)
    h = PERIOD / SUBSTEPS
    for w, start in enumerate(found.start):
        begin, end = start * PERIOD - h / 2, (start + LENGTH) * PERIOD - h / 2
        edges = np.concatenate([[begin], time[(time > begin) & (time < end)], [end]])
        held = ctrl[np.maximum(np.searchsorted(time, edges[:-1] + 1e-9) - 1, 0), 0]
        np.testing.assert_allclose(command[w].sum() * h, held @ np.diff(edges), atol=1e-5)


def test_the_past_of_a_first_window_is_the_first_row_held():
    found = cut(LOGS)
    around, back = found.batch.around, found.batch.around.start
    assert back == 25 and around.qpos.shape == (12, 2 * back + 1, 1) and found.start[0] == 0
    np.testing.assert_allclose(around.qpos[0, : back + 1, 0], LOGS[0].qpos[0, 0], rtol=1e-6)
    np.testing.assert_allclose(around.qpos[0, back:, 0], LOGS[0].qpos[: back + 1, 0], rtol=1e-6)
    inner = int(np.flatnonzero(found.start > 0)[0])
    a = found.start[inner]
    np.testing.assert_allclose(around.qpos[inner], LOGS[found.log[inner]].qpos[a - back : a + back + 1], rtol=1e-6)


def test_windows_have_a_past_where_enough_remain_and_every_log_keeps_one():
    """Five rows of past: logs of 101 rows give three windows of 25 behind it, or four with their first rows."""
    logs = [LOGS[0], LOGS[1], LOGS[2].cut(0, LENGTH + 2)]
    assert [len(log) for log in logs] == [101, 101, LENGTH + 2]
    whole, most = cut(logs), cut(logs, enough=7)
    assert [int((whole.log == r).sum()) for r in range(3)] == [4, 4, 1] and whole.start.min() == 0
    assert [int((most.log == r).sum()) for r in range(3)] == [3, 3, 1]
    assert list(most.start[most.log == 0]) == [5, 30, 55] and list(most.start[most.log == 2]) == [1]
    np.testing.assert_array_equal(cut(logs, enough=8).start, whole.start)


def test_unmeasured_velocities_are_not_compared_but_start_the_window():
    found = cut(LOGS)
    assert found.sigma_q == pytest.approx([4e-4], rel=1e-6) and np.isinf(found.sigma_v).all()
    measured = [dataclasses.replace(log, has_qvel=True) for log in LOGS]
    assert np.isfinite(cut(measured).sigma_v).all() and np.isinf(cut(measured, use_qvel=False).sigma_v).all()
    assert np.all(found.spread > 0) and found.spread[0] == pytest.approx(3 * 4e-4)


def test_drives_that_are_off_are_off_in_the_window():
    on = np.ones(len(LOGS[0]))
    on[:8] = 0
    found = cut([dataclasses.replace(LOGS[0], streams={"enabled:motor": on}), LOGS[1]])
    np.testing.assert_array_equal(np.asarray(found.batch.enabled)[0, :, 0], on[:LENGTH])
    assert np.all(np.asarray(found.batch.enabled)[found.log == 1] == 1)
