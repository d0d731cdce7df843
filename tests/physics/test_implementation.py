"""What `env.impl=auto` takes: what was measured here, else a fixed table, else jax."""

import json
from pathlib import Path

import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor.opening import opening
from bayessim_mjx.physics import implementation, measured
from bayessim_mjx.physics.implementation import choose, steps
from bayessim_mjx.versions import of

H200 = "NVIDIA H200"
FRICTION, DELAY = make("coulomb_friction", where="all"), make("actuator_delay", where="all")


@pytest.fixture(autouse=True)
def file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Warp is there, as far as auto can tell, and nothing was measured yet."""
    monkeypatch.setattr(implementation, "installed", lambda: True)
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", str(tmp_path))
    return tmp_path / measured.FILE


def measurement(worlds: int, jax: float | None, warp: float | None, other: dict[str, str] | None = None):
    return measured.Measurement("Ant", H200, worlds, jax, warp, of(measured.VERSIONS) | (other or {}))


def write(file: Path, *kept: measured.Measurement) -> None:
    file.write_text(json.dumps(measured.content(kept)))


def test_the_table_is_for_what_was_not_measured_here(monkeypatch):
    for task, worlds in (("Humanoid", 4096), ("ShadowHand", 40000)):
        assert choose(task, worlds, [DELAY], H200).impl == "warp"
    for task, worlds in (("Humanoid", 4095), ("Humanoid", None), ("Ant", 16384)):
        assert choose(task, worlds, [], H200).impl == "jax"
    assert choose("Humanoid", 4096, [], "cpu") == (
        "jax", "Humanoid was not measured on cpu with 4096 worlds or fewer; bayessim-mjx implementations does it",
    )  # fmt: skip
    assert choose("Humanoid", 4096, [FRICTION], H200) == (
        "jax", "coulomb_friction acts inside the timestep, which Warp computes as a whole",
    )  # fmt: skip
    monkeypatch.setattr(implementation, "installed", lambda: False)
    assert choose("Humanoid", 4096, [], H200) == ("jax", "warp-lang is not installed")


def test_the_nearest_measured_number_at_or_below_decides(file):
    write(file, measurement(8192, 3e6, 2e6), measurement(1024, 1e6, 2e6), measurement(32768, 3e6, 4e6))
    taken = {n: choose("Ant", n, [], H200).impl for n in (1023, 1024, 8191, 8192, 16384, 32768, 10**6)}
    assert taken == {
        1023: "jax", 1024: "warp", 8191: "warp", 8192: "jax", 16384: "jax", 32768: "warp", 10**6: "warp",
    }  # fmt: skip
    assert choose("Ant", 9000, [], H200).why == "JAX 3M, Warp 2M steps/s with 8192 worlds, measured here"
    assert choose("Ant", 2000, [FRICTION], H200).impl == "jax"
    assert choose("Ant", 2000, [], "cpu").impl == choose("Humanoid", 2000, [], H200).impl == "jax"
    assert choose("ShadowHand", 16384, [], H200).impl == "warp"  # as the table has it
    assert [(n, c.impl) for n, c in steps("Ant", (), H200)] == [
        (1, "jax"),
        (1024, "warp"),
        (8192, "jax"),
        (32768, "warp"),
    ]
    assert [(n, c.impl) for n, c in steps("Ant", [FRICTION], H200)] == [(1, "jax")]


def test_an_implementation_that_had_not_the_memory_is_not_taken(file):
    write(file, measurement(64, 1e6, None), measurement(128, None, 1e5))
    assert choose("Ant", 64, [], H200) == ("jax", "Warp did not run with 64 worlds, measured here")
    assert choose("Ant", 128, [], H200) == ("warp", "JAX did not run with 128 worlds, measured here")


@pytest.mark.parametrize(("package", "valid"), [("mujoco-mjx", False), ("warp-lang", False), ("jax", True)])
def test_measurements_with_other_versions_say_nothing(file, package, valid):
    write(file, measurement(64, 1e5, 1e6, {package: "0.0.1"}))
    assert choose("Ant", 64, [], H200).impl == ("warp" if valid else "jax")


@pytest.mark.parametrize(
    "text",
    [
        "", "{}", "[1]", '{"format": 2, "measured": []}', '{"format": 1, "measured": [{}]}',
        json.dumps(measured.content([measurement(64, -1.0, 1e6)])), "\xff",
    ],
)  # fmt: skip
def test_a_damaged_file_is_named_and_left_aside(file, text):
    file.write_bytes(text.encode("latin-1"))
    with pytest.warns(UserWarning, match=f"env.impl = 'auto' goes without measurements: {file}: not a file of measure"):
        assert choose("Humanoid", 4096, [], H200).impl == "warp"
    with pytest.raises(UserError, match="delete it and measure anew"):
        measured.read(file)


def test_without_a_cache_nothing_is_known(file, monkeypatch):
    write(file, measurement(64, 1e5, 1e6))
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", "off")
    assert measured.path() is None and choose("Ant", 64, [], H200).impl == "jax"
    monkeypatch.delenv("BAYESSIM_MJX_CACHE")
    monkeypatch.setenv("HOME", "/home/me")
    assert measured.path() == Path("/home/me/.cache/bayessim_mjx/implementations.json")


def test_a_run_says_what_auto_took_and_why(file):
    settings = config.load("Pendulum", overrides=["env.impl=auto"])
    told = opening(settings, registry.make("Pendulum", config=settings), "cpu:0")
    assert told["physics"] == (
        "MJX's JAX implementation, taken by env.impl=auto: Pendulum was not measured on cpu with 128 worlds or fewer; "
        "bayessim-mjx implementations does it"
    )
    assert "physics" not in opening(settings, registry.make("Pendulum"), "cpu:0")
