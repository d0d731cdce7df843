"""Topics of ROS that once went wrong: controllers' states, two publishers, types that cannot be read."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.ros import Choice, Message, recording
from tests.logs.importing import START, named, stamp

STEP = 10_000_000  # ns


def angle(k: int) -> float:
    return 0.5 + 0.3 * float(np.sin(0.1 * k))


def state(k: int, position: float | None = None, late: int = 0, joints: tuple[str, ...] = ("elbow", "wrist"),
          bare: bool = False, sender: str = "", frame: str = "") -> Message:  # fmt: skip
    """One JointState; `late` ns after the k-th step; `bare`: without velocities."""
    x = angle(k) if position is None else position
    header = stamp(START + STEP * k + late)
    header.frame_id = frame
    speeds = [] if bare else [0.0] * len(joints)
    body = named(header=header, name=list(joints), position=[x] * len(joints), velocity=speeds, effort=[])
    return Message("/joint_states", "JointState", START + STEP * k + late, body, sender)


def sent(k: int) -> Message:
    layout = named(dim=[named(label="elbow,wrist")])
    return Message("/u", "Float64MultiArray", START + STEP * k, named(data=[float(k), 0.0], layout=layout))


COMMANDS = [sent(k) for k in range(100)]


def interleaved(second: Callable[[int], Message], every: int = 10, first: Callable[[int], Message] = state) -> list:
    states = [m for k in range(100) for m in ([second(k), first(k)] if k % every == 3 % every else [first(k)])]
    return [*states, *COMMANDS]


OTHERS = {
    "same stamp": lambda k: state(k, 0.0),
    "4 ms later, no velocities": lambda k: state(k, 0.0, 4_000_000, bare=True),
    "4 ms later, other order": lambda k: state(k, 0.0, 4_000_000, ("wrist", "elbow")),
    "4 ms later, alike": lambda k: state(k, 0.0, 4_000_000),
    "4 ms later, another node": lambda k: state(k, 0.0, 4_000_000, sender="/robot_state_gui"),
    "4 ms later, another frame": lambda k: state(k, 0.0, 4_000_000, frame="base"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_two_publishers_are_never_merged(case: str) -> None:
    with pytest.raises(UserError, match=r"/joint_states has more than one publisher.*(--publisher N|--states TOPIC)"):
        recording("run", interleaved(OTHERS[case]), Choice())


@pytest.mark.parametrize("case", [c for c in OTHERS if c not in ("same stamp", "4 ms later, alike")])
def test_one_of_two_publishers_is_chosen(case: str) -> None:
    found = recording("run", interleaved(OTHERS[case]), Choice(publisher=1))
    np.testing.assert_allclose(found.positions["elbow"].values, [angle(k) for k in range(100)])
    zeros = recording("run", interleaved(OTHERS[case]), Choice(publisher=2))
    assert not zeros.positions["elbow"].values.any()
    with pytest.raises(UserError, match="--publisher 3; allowed: 1 to 2"):
        recording("run", interleaved(OTHERS[case]), Choice(publisher=3))


def test_alternating_publishers_of_one_form_are_seen() -> None:
    with pytest.raises(UserError, match="more than one publisher.*to and fro"):
        recording("run", interleaved(lambda k: state(k, 0.0, 4_000_000), every=1), Choice())


def flicker(k: int) -> Message:
    return state(k, 0.5 + 0.0015 * (k % 3 == 0))


def burst(k: int) -> Message:
    return state(
        k, float(np.clip(0.1 * (k - 60), 0.0, 1.5)), joints=("elbow", "wrist") if k % 2 else ("wrist", "elbow")
    )


@pytest.mark.parametrize("one", [flicker, burst, state])
def test_one_publisher_is_not_taken_for_two(one: Callable[[int], Message]) -> None:
    found = recording("run", [*(one(k) for k in range(100)), *COMMANDS], Choice())
    assert len(found.positions["elbow"].time) == 100


def test_publishers_of_different_joints_belong_together() -> None:
    hand = [state(k, 0.01 * k, 2_000_000, ("finger",)) for k in range(100)]
    found = recording("run", [*(state(k) for k in range(100)), *hand, *COMMANDS], Choice())
    assert set(found.positions) == {"elbow", "wrist", "finger"}


def controller(k: int, names: tuple[str, str] = ("reference", "feedback"), output: bool = True) -> Message:
    def point(**content: list[float]) -> Any:
        return named(**{"positions": [], "velocities": [], "effort": [], **content})

    wanted, seen = point(positions=[0.1 * k]), point(positions=[0.1 * k - 0.02], velocities=[1.0])
    out = {"output": point(effort=[2.0 * k])} if output else {}
    body = named(header=stamp(START + STEP * k), joint_names=["elbow"], **{names[0]: wanted, names[1]: seen}, **out)
    return Message("/arm_controller/state", "JointTrajectoryControllerState", START + STEP * k, body)


@pytest.mark.parametrize("names", [("reference", "feedback"), ("desired", "actual")])
def test_a_controllers_state_gives_targets_commands_and_states(names: tuple[str, str]) -> None:
    only = [controller(k, names, output=names[0] == "reference") for k in range(50)]
    columns, _ = recording("run", only, Choice()).columns()
    k = np.arange(50)
    np.testing.assert_allclose(columns["position:elbow"], 0.1 * k - 0.02)
    np.testing.assert_allclose(columns["velocity:elbow"], 1.0)
    np.testing.assert_allclose(columns["target:elbow"][:49], 0.1 * k[:49])
    sent_to = 2.0 * k if names[0] == "reference" else 0.1 * k
    np.testing.assert_allclose(columns["command:elbow"][:49], sent_to[:49])


def test_a_controllers_targets_are_commands_where_they_are_asked_for() -> None:
    only = [controller(k) for k in range(50)]
    for choice in (Choice(field="position"), Choice(targets=True)):
        found = recording("run", only, choice)
        np.testing.assert_allclose(found.columns()[0]["command:elbow"][:49], 0.1 * np.arange(49))
        assert any("commands are reference.positions" in note for note in found.notes)
    with pytest.raises(UserError, match="--field"):
        recording("run", only, Choice(field="velocity"))


def test_other_commands_come_before_a_controllers_state() -> None:
    both = [*(controller(k) for k in range(50)), *(state(k) for k in range(50)), *COMMANDS[:50]]
    found = recording("run", both, Choice())
    assert found.commands["elbow"].values[7] == 7.0 and found.positions["elbow"].values[7] == angle(7)


def test_topics_that_cannot_be_read_are_named_with_their_types() -> None:
    strange = Message("/low_state", "unitree_go/msg/LowState", 0, None)
    with pytest.raises(
        UserError, match=r"no topic of commands.*cannot be read: /low_state \(unitree_go/msg/LowState\)"
    ):
        recording("run", [strange, *(state(k) for k in range(20))], Choice())
    found = recording("run", [strange, *interleaved(state)], Choice())
    assert any("/low_state (unitree_go/msg/LowState)" in note for note in found.notes)


def header(k: int) -> Any:
    return stamp(START + STEP * k)


def test_dynamic_joint_states_are_states_with_further_interfaces() -> None:
    def state(k: int) -> Message:
        values = [named(interface_names=["position", "current"], values=[0.01 * k, 2.0]),
                  named(interface_names=["effort"], values=[1.0])]  # fmt: skip
        body = named(header=header(k), joint_names=["elbow", "gripper"], interface_values=values)
        return Message("/dynamic_joint_states", "DynamicJointState", START + STEP * k, body)

    sent = [Message("/u", "Float64", START + STEP * k, named(data=float(k))) for k in range(50)]
    found = recording("run", [*map(state, range(50)), *sent], Choice())
    np.testing.assert_allclose(found.positions["elbow"].values, 0.01 * np.arange(50))
    assert list(found.positions) == ["elbow"] and set(found.others["current:elbow"].values) == {2.0}
    assert set(found.efforts["gripper"].values) == {1.0} and found.commands["elbow"].values[7] == 7.0


def test_joints_of_several_numbers_are_positions_of_a_free_joint() -> None:
    def pose(k: int) -> Message:
        half, sign = 0.005 * k, -1 if k % 2 else 1
        move = named(translation=named(x=0.1 * k, y=0.0, z=1.0),
                     rotation=named(w=sign * np.cos(half), x=0.0, y=0.0, z=sign * np.sin(half)))  # fmt: skip
        body = named(header=header(k), joint_names=["root"], transforms=[move], twist=[], wrench=[])
        return Message("/multi", "MultiDOFJointState", START + STEP * k, body)

    wheel = [
        Message("/joint_states", "JointState", START + STEP * k,
                named(header=header(k), name=["wheel"], position=[float(k)], velocity=[], effort=[]))
        for k in range(50)
    ]  # fmt: skip
    sent = [Message("/u", "Float64MultiArray", START + STEP * k, named(data=[1.0])) for k in range(50)]
    choice = Choice(commands={"/u": ("wheel",)})
    for states in (wheel, []):
        found = recording("run", [*map(pose, range(50)), *states, *sent], choice)
        columns, _ = found.columns()
        np.testing.assert_allclose(columns["position:root[0]"], 0.1 * np.arange(50))
        np.testing.assert_allclose(columns["position:root[3]"], np.cos(0.005 * np.arange(50)))
        assert ("position:wheel" in columns) == bool(states)
