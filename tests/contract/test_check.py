"""Logs of a deployed policy against its contract: every planted mistake is named, and nothing else."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
pytest.importorskip("onnx", reason="the extra [export] is not installed")

from bayessim_mjx.contract import words  # noqa: E402
from bayessim_mjx.contract.check import check  # noqa: E402
from bayessim_mjx.contract.evidence import Result  # noqa: E402
from tests.contract import robots  # noqa: E402
from tests.contract.robots import HOME, observe  # noqa: E402

Observe = Callable[[dict[str, np.ndarray], int, np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return robots.write_policy(tmp_path_factory.mktemp("policy") / "policy.onnx")


def found(result: Result) -> set[tuple[str, str, tuple[str, ...]]]:
    return {(f.part, f.kind, f.entries) for f in result.findings}


def changed(where: slice, how: Callable[..., Any]) -> Observe:
    """The observation with one part computed otherwise."""

    def wrong(m: dict[str, np.ndarray], k: int, last: np.ndarray) -> np.ndarray:
        seen = observe(m, k, last)
        seen[where] = how(m, k, seen[where])
        return seen

    return wrong


DRAWN = np.random.default_rng(0)
GRAVITY, SPIN, PLACES, SPEEDS, LAST = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 10), slice(10, 12)
names = lambda part: tuple(robots.NAMES[part])  # noqa: E731
WRONG: dict[str, tuple[Observe, set]] = {
    "swapped": (changed(PLACES, lambda m, k, x: (m["q"][k] - HOME)[::-1]), {("order", names(PLACES))}),
    "hip": (changed(PLACES, lambda m, k, x: x * [-1, 1]), {("sign", ("hip_position",))}),
    "degrees": (changed(SPIN, lambda m, k, x: np.degrees(x)), {("unit", names(SPIN))}),
    "world": (changed(GRAVITY, lambda m, k, x: [0, 0, -1]), {("frame", names(GRAVITY))}),
    "inverse": (changed(GRAVITY, lambda m, k, x: -robots.rotation(m["quat"][k])[:, 2]), {("frame", names(GRAVITY))}),
    "mount": (changed(SPIN, lambda m, k, x: [-x[1], x[0], x[2]]), {("axes", names(SPIN))}),
    "pose": (changed(PLACES, lambda m, k, x: m["q"][k]), {("pose_missing", names(PLACES))}),
    "scale": (changed(SPEEDS, lambda m, k, x: 20 * x), {("scale_missing", names(SPEEDS))}),
    "twice": (changed(SPEEDS, lambda m, k, x: 0.05 * x), {("scale_twice", names(SPEEDS))}),
    "late": (changed(SPEEDS, lambda m, k, x: 0.05 * m["v"][max(k - 1, 0)]), {("delay", names(SPEEDS))}),
    "all late": (lambda m, k, last: observe(m, max(k - 2, 0), np.zeros(2)), set()),
    "dead": (changed(PLACES, lambda m, k, x: [0.2, x[1]]), {("frozen", ("hip_position",))}),
    "not fed back": (changed(LAST, lambda m, k, x: 0 * x), {("frozen", names(LAST))}),
    "command back": (changed(LAST, lambda m, k, x: HOME + 0.5 * x), {("command_fed_back", names(LAST))}),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_mistakes_of_observations(case: str, noise: float, policy: Path, tmp_path: Path) -> None:
    observation, truth = WRONG[case]
    robots.write_log(tmp_path / "run.csv", observation, noise=noise)
    got = {(kind, entries) for part, kind, entries in found(check(policy, tmp_path)) if part == "observation"}
    if case == "all late":  # the groups that follow from the state share their delay
        assert ("frozen", names(LAST)) in got and any(kind == "delay" for kind, _ in got)
    else:
        assert got == truth


COMMANDS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], tuple[str, tuple[str, ...]]]] = {
    "scale": (lambda a: HOME + 0.25 * a, ("scale_twice", robots.JOINTS)),
    "other scale": (lambda a: HOME + 0.4 * a, ("scale", robots.JOINTS)),
    "sign": (lambda a: HOME + 0.5 * a * [1, -1], ("sign", ("knee",))),
    "order": (lambda a: (HOME + 0.5 * a)[::-1], ("order", robots.JOINTS)),
    "pose": (lambda a: 0.5 * a, ("pose_missing", robots.JOINTS)),
}


@pytest.mark.parametrize("case", COMMANDS)
def test_mistakes_of_commands(case: str, policy: Path, tmp_path: Path) -> None:
    command, truth = COMMANDS[case]
    robots.write_log(tmp_path / "run.csv", command=command)
    assert found(check(policy, tmp_path)) == {("command", *truth)}


def test_a_common_factor_of_unequal_scales_is_a_ratio_with_each_entry_s_numbers(tmp_path: Path) -> None:
    facts = robots.manifest() | {"action_scale": [0.5, 0.25]}
    policy = robots.write_policy(tmp_path / "policy.onnx", facts)
    robots.write_log(tmp_path / "logs" / "run.csv", command=lambda a: HOME + 0.7 * np.array([0.5, 0.25]) * a)
    (finding,) = check(policy, tmp_path / "logs").findings
    assert finding.kind == "scale" and words.sentence(finding) == "scale 0.7 times the file's"
    assert finding.each == {"hip": (pytest.approx(0.35), 0.5), "knee": (pytest.approx(0.175), 0.25)}


@pytest.mark.parametrize(
    ("acted", "kind"),
    [
        (lambda o: np.tanh(o @ robots.weights()), "normaliser_missing"),
        (lambda o: robots.act((o - 0.1) / 0.6), "normaliser_twice"),
        (lambda o: np.tanh((o - 0.1) / 0.6 @ robots.weights(7)), "other_policy"),
        (lambda o: robots.act(o) + 0.1 * DRAWN.normal(size=2), "noise"),
        (lambda o: np.clip(robots.act(o), -0.5, 0.5), "clip_smaller"),
    ],
)
def test_mistakes_of_actions(acted: Any, kind: str, policy: Path, tmp_path: Path) -> None:
    robots.write_log(tmp_path / "run.csv", acted=acted)
    assert (kind, "action") in {(f.kind, f.part) for f in check(policy, tmp_path).findings}


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.03])
@pytest.mark.parametrize("drop", [(), ("qvel",), ("qpos", "qvel"), ("ctrl",), ("action",)], ids=str)
def test_a_right_deployment_is_not_accused(noise: float, drop: tuple[str, ...], policy: Path, tmp_path: Path) -> None:
    for seed in range(2):
        robots.write_log(tmp_path / f"run{seed}.csv", noise=noise, seed=seed, drop=drop)
    result = check(policy, tmp_path)
    assert not result.findings
    assert len(result.compared["action"] if drop != ("action",) else result.compared["command"]) == 2


STATE_ONLY = ("observation", "action")


@pytest.mark.parametrize("case", ["swapped", "hip", "degrees", "world", "pose", "scale", "late"])
def test_mistakes_are_found_through_the_network_where_no_observation_is_logged(
    case: str, policy: Path, tmp_path: Path
) -> None:
    observation, truth = WRONG[case]
    robots.write_log(tmp_path / "run.csv", observation, drop=STATE_ONLY)
    assert found(check(policy, tmp_path)) == {("observation", kind, entries) for kind, entries in truth}


def of_a_circle() -> dict[str, Any]:
    """The manifest of a policy that sees sine and cosine of the hip in place of both joints' angles."""
    facts = robots.manifest()
    for i, source in enumerate(("sin:hip", "cos:hip")):
        facts["observation_meaning"][6 + i] = {"terms": {source: 1.0}, "offset": 0.0, "unit": "rad"}
    return facts


@pytest.mark.parametrize("offset", [0.3, -2.0])  # rad
def test_an_offset_of_a_joint_is_found_through_its_sine_and_cosine(offset: float, tmp_path: Path) -> None:
    policy = robots.write_policy(tmp_path / "policy.onnx", of_a_circle())
    turned = lambda m, k, x: [np.sin(m["q"][k][0] + offset), np.cos(m["q"][k][0] + offset)]  # noqa: E731
    robots.write_log(tmp_path / "logs" / "run.csv", changed(PLACES, turned), drop=STATE_ONLY)
    (finding,) = check(policy, tmp_path / "logs").findings
    assert (finding.kind, finding.entries) == ("offset", names(PLACES))
    assert finding.found == pytest.approx(offset, abs=1e-3)


def test_the_error_now_is_that_of_the_mistake_and_not_of_a_line(policy: Path, tmp_path: Path) -> None:
    """A flipped sign doubles the motion: four times its variance, and four times its squared mean."""
    observation, _ = WRONG["hip"]
    robots.write_log(tmp_path / "run.csv", observation)
    (finding,) = check(policy, tmp_path).findings
    seen = robots.motion(0, 300)["q"][:, 0] - HOME[0]
    assert finding.before == pytest.approx(4 * np.mean(seen**2) / np.var(seen), rel=1e-6)
    assert finding.left is not None and finding.left < 1e-5
    assert words.evidence(finding) == "over 100 %, 0 %"


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.03])
def test_a_right_deployment_of_which_only_the_state_is_logged(noise: float, policy: Path, tmp_path: Path) -> None:
    robots.write_log(tmp_path / "run.csv", noise=noise, drop=STATE_ONLY)
    result = check(policy, tmp_path)
    assert not result.findings and {"rebuilt", "rebuilt_unlike"} & {*result.notes}


def test_a_rate_and_steps_that_are_left_out(policy: Path, tmp_path: Path) -> None:
    robots.write_log(tmp_path / "run.csv", dt=0.025)
    (finding,) = check(policy, tmp_path).findings
    assert (finding.part, finding.kind) == ("clock", "rate")
    assert finding.found == pytest.approx(40) and finding.expected == pytest.approx(50)


def test_what_does_not_move_cannot_be_told(policy: Path, tmp_path: Path) -> None:
    still = lambda m, k, last: observe({**m, "q": 0 * m["q"] + HOME}, k, last)  # noqa: E731
    log = robots.write_log(tmp_path / "run.csv", still)
    text = log.read_text().splitlines()
    place = [i for i, n in enumerate(text[0].split(",")) if n in ("qpos:hip", "qpos:knee")]
    rows = [line.split(",") for line in text[1:]]
    for row in rows:
        for i, home in zip(place, HOME, strict=True):
            row[i] = f"{home}"
    log.write_text("\n".join([text[0], *(",".join(row) for row in rows)]) + "\n")
    result = check(policy, tmp_path)
    assert not result.findings and {result.untold[f"{j}_position"] for j in robots.JOINTS} == {"still"}


def test_several_rows_for_each_step(policy: Path, tmp_path: Path) -> None:
    """A log with four rows for each step of the policy, between which observation and action are held."""
    log = robots.write_log(tmp_path / "run.csv")
    head, *lines = log.read_text().splitlines()
    rows = [f"{0.005 * (4 * k + i):.6g},{line.split(',', 1)[1]}" for k, line in enumerate(lines) for i in range(4)]
    log.write_text("\n".join([head, *rows]) + "\n")
    result = check(policy, tmp_path)
    assert not result.findings and "rate" in result.compared["clock"]


def thinned(log: Path, n: int) -> None:
    """Keep every nth row."""
    head, *lines = log.read_text().splitlines()
    log.write_text("\n".join([head, *lines[::n]]) + "\n")


def of_no_memory() -> dict[str, Any]:
    """The manifest of a policy that is given speeds in place of its previous actions."""
    facts = robots.manifest()
    facts["observation_meaning"][10:] = [{"terms": {"qvel:hip": 0.05}, "offset": 0.0, "unit": "rad/s"}] * 2
    return facts


def test_half_the_rate_is_known_from_a_log_of_every_second_step(tmp_path: Path) -> None:
    fed_back = robots.write_policy(tmp_path / "a.onnx")
    robots.write_log(tmp_path / "slow" / "run.csv", dt=0.04)
    (finding,) = check(fed_back, tmp_path / "slow").findings  # its previous actions are those of the row before
    assert (finding.kind, finding.found) == ("rate", pytest.approx(25))
    thinned(robots.write_log(tmp_path / "thin" / "run.csv", steps=800), 2)
    result = check(fed_back, tmp_path / "thin")
    assert words.outcome(result) == "right" and "the log has every 2nd step only" in words.note(result.notes[-1])
    held = robots.write_log(tmp_path / "held" / "run.csv", dt=0.04)
    head, *lines = held.read_text().splitlines()
    rows = [f"{0.01 * (4 * k + i):.6g},{line.split(',', 1)[1]}" for k, line in enumerate(lines) for i in range(4)]
    held.write_text("\n".join([head, *rows]) + "\n")
    assert [f.kind for f in check(fed_back, tmp_path / "held").findings] == ["rate"]


def test_a_rate_that_nothing_shows_is_unknown(tmp_path: Path) -> None:
    policy = robots.write_policy(tmp_path / "b.onnx", of_no_memory())
    speeds = changed(LAST, lambda m, k, x: 0.05 * m["v"][k][[0, 0]])
    robots.write_log(tmp_path / "logs" / "run.csv", speeds, dt=0.04)
    result = check(policy, tmp_path / "logs")
    assert not result.findings and words.outcome(result) == "unknown"
    assert words.verdict(result).startswith("unknown: the rate of control") and "2nd" in words.note(result.notes[-1])
