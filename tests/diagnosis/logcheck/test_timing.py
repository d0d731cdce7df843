"""One clock: what is late behind what, with its error, from logs whose delays are known."""

import mujoco
import pytest

from bayessim_mjx.diagnosis.logcheck.gate import check, pooled
from bayessim_mjx.diagnosis.logcheck.timing import Late
from tests.diagnosis.recordings import PENDULUM, record, sines

PERIOD = 0.01  # s, for which each command holds


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.03])
def test_motion_follows_held_commands_half_a_row_later_and_a_delay_beside(delay: float) -> None:
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    logs = [record(PENDULUM, sines((1.5,), seed=seed), delay=delay, qvel=True) for seed in (0, 1)]
    timing = check(logs, model, PERIOD).timing
    motion = timing.motion["hinge"]
    assert motion.seconds == pytest.approx(PERIOD / 2 + delay, abs=4 * motion.error) and 0 < motion.error < 2e-3
    assert timing.velocities["hinge"].seconds == pytest.approx(0.0, abs=1e-3)


def test_commands_are_moved_once_and_said() -> None:
    log = record(PENDULUM, sines((1.5,)))
    gate = check([log], mujoco.MjModel.from_xml_string(PENDULUM), PERIOD)
    led = gate.moved(-0.003)
    assert led.usable[0].late == pytest.approx(-0.003) and led.timing.moved == -0.003
    kept = gate.moved(0.0)
    assert kept.usable == gate.usable and kept.timing.moved == 0.0


def test_a_lateness_within_four_errors_is_none() -> None:
    assert Late(0.003, 1e-3).sure == 0.0 and Late(-0.005, 1e-3).sure == -0.005
    assert Late(0.003).sure == 0.003  # of unknown error
    each = [("hinge", Late(x, 0.002)) for x in (0.01, 0.03, 0.011, 0.012)]
    assert pooled(each) == {"hinge": Late(pytest.approx(0.0115), pytest.approx(0.001))}
    assert pooled([*each, ("hinge", Late(0.0115))]) == pooled(each)  # an unknown error says nothing


def test_motion_is_late_where_it_is_surely_another_rows() -> None:
    row = 0.01
    assert Late(0.005, 1e-4).beyond(row) == Late(-0.004, 1e-4).beyond(row) == Late(0.014, 1e-4).beyond(row) == 0.0
    assert Late(0.016, 1e-4).beyond(row) == 0.016 and Late(-0.006, 1e-4).beyond(row) == -0.006
    assert Late(0.016, 1e-3).beyond(row) == 0.0 and Late(0.3).beyond(row) == 0.0  # of unknown error
