"""Delays and losses of messages, read from the times at which they were sent and received."""

from pathlib import Path

import numpy as np
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.effects.support.reading import listed
from bayessim_mjx.logs.transport import transport
from tests.logs.importing import model_of
from tests.logs.log_files import HEADER, rows, write

PERIOD = 0.01
LAWS = {
    "gamma": lambda rng, n: rng.gamma(4.0, 0.001, n),
    "uniform": lambda rng, n: rng.uniform(0.002, 0.006, n),
    "two_point": lambda rng, n: np.where(rng.random(n) < 0.5, 0.002, 0.006),
}


def stamps(law, n=2000, loss=0.1, seed=0):
    rng = np.random.default_rng(seed)
    sent = 1000.0 + PERIOD * np.arange(n)
    received = sent + LAWS[law](rng, n)
    return sent, np.where(rng.random(n) < loss, np.nan, received)


@pytest.mark.parametrize("law", LAWS)
def test_the_law_that_made_the_delays_is_found_with_its_mean_spread_and_loss(law):
    found = transport(*stamps(law))
    sd = {"gamma": 0.002, "uniform": 0.004 / 12**0.5, "two_point": 0.002}[law]
    assert found.law == law and found.mean == pytest.approx(0.004, abs=2e-4)
    assert found.jitter == pytest.approx(sd, rel=0.08) and found.loss == pytest.approx(0.1, abs=0.025)
    assert not found.ahead and abs(found.correlation) < 0.1 and found.messages == 2000


def test_rows_that_show_a_message_twice_count_once():
    sent, received = stamps("gamma", 500)
    assert transport(np.repeat(sent, 3), np.repeat(received, 3)) == transport(sent, received)


def test_two_clocks_leave_the_spread_but_not_the_mean():
    sent, received = stamps("uniform")
    found = transport(sent, received - 0.5)
    assert found.ahead and found.mean == pytest.approx(0.002, abs=2e-4)  # counted from the fastest
    assert found.jitter == pytest.approx(transport(sent, received).jitter)


def test_few_messages_are_no_distribution():
    assert transport(*stamps("gamma", 20, loss=0)) is None


def checked(tmp_path: Path, columns: dict[str, np.ndarray], capsys: pytest.CaptureFixture) -> str:
    table = rows(400)
    (tmp_path / "logs").mkdir()
    every = np.column_stack([table, *(x[: len(table)] for x in columns.values())])
    write(tmp_path / "logs", every, ",".join([HEADER, *columns]), "run.csv")
    import_logs.main(["check", str(tmp_path / "logs"), "--model", str(model_of(tmp_path))])
    return capsys.readouterr().out


def test_logs_check_shows_them_and_the_effect_that_has_them(tmp_path, capsys):
    sent, received = stamps("two_point", loss=0.0)
    out = checked(tmp_path, {"sent:command": sent, "received:command": received}, capsys)
    (line,) = [line for line in out.splitlines() if "commands arrive" in line]
    assert "0 % of" in line and "law: two_point" in line and "command_packets" in line
    import yaml

    (effect,) = listed([yaml.safe_load(line.partition("for training: ")[2])])  # as it would stand in a configuration
    delay = effect.space().parameters[0]
    assert effect.law == "two_point" and delay.nominal == pytest.approx(0.004, rel=0.1)


def test_stamps_in_ns_since_1970_and_one_end_alone_are_said(tmp_path, capsys):
    sent, _ = stamps("gamma")
    out = checked(tmp_path, {"sent:measurement": sent}, capsys)
    assert "sent:measurement gives no delay without received:measurement" in out
