"""`bayessim-mjx implementations`: what it measures, says and keeps; Warp is feigned but for one slow test."""

import json
from pathlib import Path
from typing import Any

import pytest

from bayessim_mjx import implementations, main, registry
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics import implementation, measured
from bayessim_mjx.rl import speed
from bayessim_mjx.rl.speed import Speed
from tests.commands.toy_runs import TOY, error_of

INSTALLED = implementation.installed()
CARTPOLE = ("--task", "cartpole", "--headless")


@pytest.fixture
def file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / measured.FILE


def feign(monkeypatch: pytest.MonkeyPatch, speeds: dict[tuple[str, int], Any]) -> list[tuple[str, int, float]]:
    """Warp is there, and each (implementation, worlds) as fast as said, or fails so; what was asked, with seconds."""
    monkeypatch.setattr(implementation, "installed", lambda: True)
    monkeypatch.setattr(implementations, "_quiet", lambda: None)
    make, asked = registry.make, []

    def feigned(name: str, *, impl: str = "jax", **more: Any) -> Any:
        env = make(name, impl="jax", **more)
        env.asked = impl
        return env

    def measure(env: Any, worlds: int, steps: int, seconds: float) -> Speed:
        assert steps == 16
        asked.append((env.asked, worlds, seconds))
        found = speeds[env.asked, worlds]
        if isinstance(found, Exception):
            raise found
        return Speed((0.9 * found, found, 1.1 * found), 3.0)

    monkeypatch.setattr(registry, "make", feigned)
    monkeypatch.setattr(speed, "measure", measure)
    return asked


def kept(file: Path) -> dict[int, tuple[float | None, float | None]]:
    return {m.worlds: (m.jax, m.warp) for m in measured.read(file)}


def test_both_are_measured_told_and_kept(file: Path, monkeypatch: Any, capsys: Any) -> None:
    speeds = {("jax", 64): 1e6, ("warp", 64): 5e5, ("jax", 256): 2e6, ("warp", 256): 8e6}
    asked = feign(monkeypatch, speeds)
    assert implementations.main([*CARTPOLE, "--num_envs", "256", "64", "256", "--seconds", "20"]) == 0
    assert asked == [("jax", 64, 5.0), ("warp", 64, 5.0), ("jax", 256, 5.0), ("warp", 256, 5.0)]
    told = capsys.readouterr().out
    assert "256 worlds: Warp 8M (7.2M to 8.8M) steps/s, compiled or loaded in 3.0 s" in told
    assert "env.impl=auto takes for Cartpole on cpu: jax, warp from 256 worlds on\n" in told
    assert f"kept in {file}; --forget removes it" in told
    rows = [" ".join(line.split()) for line in told.splitlines()]
    assert "64 1M (900k to 1.1M) 500k (450k to 550k) 0.5 3.0 s, 3.0 s" in rows
    assert kept(file) == {64: (1e6, 5e5), 256: (2e6, 8e6)} and set(file.parent.iterdir()) >= {file}
    assert json.loads(file.read_text())["measured"][0]["versions"].keys() == set(measured.VERSIONS)
    assert implementation.choose("Cartpole", 300).impl == "warp"
    speeds["warp", 256] = 1e6
    assert implementations.main([*CARTPOLE, "--num_envs", "256"]) == 0
    assert kept(file) == {64: (1e6, 5e5), 256: (2e6, 1e6)}


def test_fewer_iterations_of_the_solver_are_told_of(file: Path, monkeypatch: Any, capsys: Any) -> None:
    feign(monkeypatch, {("jax", 8): 1e3, ("warp", 8): 2e3})
    assert implementations.main(["--task", "Ant", "--num_envs", "8", "--headless"]) == 0
    assert "fewer solver iterations (1) than Warp makes (up to 20), so the motion may differ" in capsys.readouterr().out


def test_memory_that_is_too_small_for_one_decides_for_the_other(file: Path, monkeypatch: Any, capsys: Any) -> None:
    short = RuntimeError("RESOURCE_EXHAUSTED: out of memory")
    feign(monkeypatch, {("jax", 8): short, ("warp", 8): 1e3, ("jax", 16): short, ("warp", 16): short})
    assert implementations.main([*CARTPOLE, "--num_envs", "8", "16"]) == 0
    assert "8 worlds: JAX: out of memory" in capsys.readouterr().out
    assert kept(file) == {8: (None, 1e3)} and implementation.choose("Cartpole", 8).impl == "warp"


def test_what_warp_refuses_while_it_is_compiled_is_told_and_not_kept(file: Path, monkeypatch: Any, capsys: Any) -> None:
    refusal = UserError("env.impl = 'warp': a parameter changes dof_x, which Warp's models do not have")
    feign(monkeypatch, {("jax", 8): 1e3, ("warp", 8): refusal})
    assert implementations.main([*CARTPOLE, "--num_envs", "8"]) == 0
    told = capsys.readouterr().out
    assert "8 worlds: Warp: a parameter changes dof_x" in told and "kept in" not in told and not file.exists()


def test_without_a_cache_it_says_that_nothing_is_kept(monkeypatch: Any, capsys: Any) -> None:
    feign(monkeypatch, {("jax", 8): 1e3, ("warp", 8): 2e3})
    assert implementations.main([*CARTPOLE, "--num_envs", "8"]) == 0
    assert "nothing is kept, as $BAYESSIM_MJX_CACHE is off" in capsys.readouterr().out


@pytest.mark.parametrize("why", ["needs the package warp-lang: pip", ": coulomb_friction acts inside the timestep"])
def test_where_warp_cannot_be_jax_alone_is_measured(why: str, file: Path, monkeypatch: Any, capsys: Any) -> None:
    make = registry.make

    def refusing(name: str, *, impl: str = "jax", **more: Any) -> Any:
        if impl == "warp":
            raise UserError(f"env.impl = 'warp' {why}" if why.startswith("needs") else f"env.impl = 'warp'{why}")
        return make(name, impl=impl, **more)

    monkeypatch.setattr(registry, "make", refusing)
    assert implementations.main([*CARTPOLE, "--num_envs", "4", "--seconds", "0.1"]) == 0
    told = capsys.readouterr().out
    assert f"warning: Warp is left out, so nothing is kept for env.impl=auto: {why.removeprefix(': ')}" in told
    assert "4 worlds: JAX " in told and "auto takes for Cartpole on cpu: jax\n" in told and "Warp / JAX" not in told
    assert not file.exists()


def test_a_task_can_be_forgotten(file: Path, monkeypatch: Any, capsys: Any) -> None:
    feign(monkeypatch, {("jax", 8): 1e3, ("warp", 8): 2e3})
    for task in ("Cartpole", "Ingenuity"):
        assert implementations.main(["--task", task, "--num_envs", "8", "--headless"]) == 0
    for number in ("1 measurement", "0 measurements"):
        assert implementations.main([*CARTPOLE, "--forget"]) == 0
        assert f"{number} of Cartpole removed from {file}\n" in capsys.readouterr().out
    assert [m.task for m in measured.read(file)] == ["Ingenuity"]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "Cartpol"], ["'Cartpol'", "Did you mean Cartpole"]),
        (["--task", "brax:ant"], ["brax:ant: it is not simulated here"]),
        (["--task", "playground:CartpoleBalance"], ["chooses its implementation itself"]),
        (["--task", "robot.xml"], ["a model's file is no task"]),
        (["--task", "Ant", "--num_envs", "0"], ["--num_envs", "0: must be from 1 to"]),
        (["--task", "Ant", "--num_envs", "64", "-3"], ["-3"]),
        (["--task", "Ant", "--num_envs", "many"], ["--num_envs", "'many'"]),
        (["--task", "Ant", "--seconds", "0"], ["--seconds", "allowed: seconds, more than 0"]),
        (["--task", "Ant", "--seconds", "nan"], ["--seconds", "'nan'"]),
        (["--task", "Ant", "--device", "abacus"], ["device = 'abacus'"]),
        ([], ["--task"]),
    ],
)
def test_bad_input_is_one_line(argv: list[str], words: list[str], capsys: Any) -> None:
    line = error_of(capsys, implementations.main, *argv)
    assert all(word in line for word in words), line


@pytest.mark.parametrize("more", [(), ("--forget",)])
def test_a_damaged_file_is_named_before_anything_is_measured(more: Any, file: Path, capsys: Any) -> None:
    file.parent.mkdir()
    file.write_text("{")
    line = error_of(capsys, implementations.main, *CARTPOLE, *more)
    assert f"{file}: not a file of measurements" in line and "delete it" in line


def test_help_is_found_by_the_name(capsys: pytest.CaptureFixture) -> None:
    assert main.main(["implementations", "--help"]) == 0
    assert "--forget" in capsys.readouterr().out


class Clock:
    """A second goes by with every look at it but the first, which compiles for ten."""

    def __init__(self, each: float = 1.0):
        self.each, self.time, self.looks = each, 0.0, 0

    def __call__(self) -> float:
        self.looks += 1
        self.time += 10.0 if self.looks == 2 else self.each
        return self.time


def test_repetitions_fill_the_time_and_compiling_is_apart() -> None:
    found = speed.measure(TOY, 4, 6, 5.0, Clock())
    assert found == Speed((24.0,) * 5, 9.0) and found.median == 24.0
    assert speed.measure(TOY, 4, 6, 0.5, Clock()) == Speed((24.0,), 9.0)  # one rollout takes longer than all may
    assert len(speed.measure(TOY, 4, 6, 2.5, Clock()).rates) == 3  # of one rollout each, until the time is over


def test_rollouts_compile_once(capsys: pytest.CaptureFixture) -> None:
    import jax

    begin, run = speed._programs(TOY, 4, 6)
    states = begin(jax.random.PRNGKey(0))
    for i in range(3):
        states, seen = run(jax.random.PRNGKey(i), states)
    assert run._cache_size() == 1 and seen["reward"].shape == ()
    assert 0 < seen["truncated"] < 0.5  # episodes end, and new ones begin


@pytest.mark.slow
@pytest.mark.skipif(not INSTALLED, reason="warp-lang is not installed")
def test_warp_itself_is_measured(file: Path, capsys: Any) -> None:
    assert implementations.main([*CARTPOLE, "--num_envs", "8", "--seconds", "4"]) == 0
    [(jax_rate, warp_rate)] = kept(file).values()
    assert jax_rate and warp_rate and "Module " not in capsys.readouterr().out
