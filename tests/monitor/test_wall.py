"""Rewards over seconds: one point per second, and a resumed run goes on where its checkpoint was."""

from bayessim_mjx.monitor.writer import event_files, records
from bayessim_mjx.monitor.writers import Wall, marked

METRICS = {"Train/mean_reward": 1.0, "Train/mean_episode_length": 5.0, "Loss/kl": 0.1}


def points(path, tag="Train/mean_reward/time"):
    files = event_files(path / "rl_time")
    return [
        event.step for file in files for _, event in records(file) for value in event.summary.value if value.tag == tag
    ]


def run(path, seconds, resumed_at=None, start=100.0):
    """A session with metrics at `seconds` after its start; the clock stands at the last one."""
    clock = [start]
    wall = Wall(path, resumed_at, now=lambda: clock[0])
    for second in seconds:
        clock[0] = start + second
        wall.scalars(METRICS)
    return wall


def test_one_point_per_second_under_rsl_rls_tags(tmp_path):
    run(tmp_path, [0.2, 0.7, 1.1, 3.9, 3.95]).close()
    assert points(tmp_path) == points(tmp_path, "Train/mean_episode_length/time") == [0, 1, 3]
    tags = {v.tag for f in event_files(tmp_path / "rl_time") for _, e in records(f) for v in e.summary.value}
    assert tags == {"Train/mean_reward/time", "Train/mean_episode_length/time"}


def test_a_resumed_clock_goes_on_from_the_checkpoint(tmp_path):
    wall = run(tmp_path, [0.5, 2.5])
    second = wall.mark()  # a checkpoint at 2.5 s
    wall.scalars(METRICS)
    wall.close()
    run(tmp_path, [3.5, 4.5], resumed_at=2).close()  # a session that was killed after it
    run(tmp_path, [0.1, 1.2], resumed_at=second, start=9000.0).close()
    assert second == 2 and points(tmp_path) == [0, 2, 3, 4]


def test_a_run_without_a_checkpoint_begins_again(tmp_path):
    run(tmp_path, [0.5, 2.5]).close()
    run(tmp_path, [0.5], resumed_at=-1).close()
    assert points(tmp_path) == [0]


def test_a_checkpoint_without_a_clock_begins_again():
    assert marked({"seconds": 3}) == 3
    assert marked({}) == marked({"seconds": "3"}) == marked({"seconds": True}) == -1
