"""Manifests and indices that are damaged, foreign or dishonest."""

import json
from pathlib import Path
from typing import Any

import pytest

from bayessim_mjx import runs
from bayessim_mjx.errors import UserError
from bayessim_mjx.runs import Run
from tests.runs.small_runs import same_bits, tree


@pytest.mark.parametrize(
    "path",
    ["/elsewhere", "../elsewhere", "checkpoints/../../elsewhere", "checkpoints/..", "checkpoints", "x/000000001"],
)
def test_a_manifest_cannot_name_what_lies_outside_of_its_run(run: Run, tmp_path: Path, path: str) -> None:
    """A foreign run.json once had any folder that it named renamed, as a damaged checkpoint."""
    outside = run.path / ".." / "elsewhere"
    outside.mkdir()
    run.save(1, tree())
    manifest = json.loads((run.path / "run.json").read_text())
    manifest["checkpoints"][0]["path"] = str(outside.resolve()) if path == "/elsewhere" else path
    (run.path / "run.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=r"run\.json: damaged manifest: checkpoints: path = .*checkpoints/<name>"):
        Run.open(run.path)
    assert outside.is_dir()


def test_what_lies_behind_a_link_is_not_swept(run: Run, tmp_path: Path) -> None:
    """Nor what `save` did not make."""
    foreign = tmp_path / "foreign" / "000000009"
    foreign.mkdir(parents=True)
    (foreign / "thesis.tex").write_text("x")
    (run.path / "checkpoints").symlink_to(foreign.parent)
    run.save(1, tree(1))
    run.save(2, tree(2))
    assert (foreign / "thesis.tex").is_file() and run.manifest["latest"] == 2
    (run.path / "checkpoints").unlink()
    (run.path / "checkpoints" / "notes").mkdir(parents=True)
    (run.path / "checkpoints" / "000000007").symlink_to(foreign)
    (run.path / "checkpoints" / "000000008").mkdir()
    run.save(3, tree(3))
    left = {p.name for p in (run.path / "checkpoints").iterdir()}
    assert left == {"notes", "000000003", "000000007"} and (foreign / "thesis.tex").is_file()


@pytest.mark.parametrize(("key", "value"), [("shape", [2, 2]), ("dtype", "int8"), ("name", "v.0"), ("step", 7)])
def test_an_index_that_was_changed_is_damage_not_another_task(run: Run, key: str, value: object, capsys: Any) -> None:
    run.save(1, tree(1))
    path = run.save(2, tree(2))
    index = json.loads((path / "index.json").read_text())
    (index if key == "step" else index["parts"]["policy"][0])[key] = value
    (path / "index.json").write_text(json.dumps(index))
    assert same_bits(run.restore("latest", tree(0), fall_back=True)[0], tree(1))
    assert "damaged checkpoint index: it differs from its checksum" in capsys.readouterr().err


def test_damaged_manifest_and_foreign_folder(run: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not a run folder"):
        Run.open(tmp_path / "nowhere")
    (run.path / "run.json").write_text('{"schema": 1, "checkpoints": [')
    with pytest.raises(UserError, match=r"run\.json: damaged manifest"):
        Run.open(run.path)
    with pytest.raises(UserError, match="no run of"):
        runs.latest_run(run.path.parents[1], "Pendulum")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("best", "gone"),
        ("best", 7),
        ("latest", "1"),
        ("task", 3),
        ("created", None),
        ("checkpoints", {"step": 1}),
        ("checkpoints", [3]),
        ("checkpoints", [{"step": "1", "path": "x", "evaluation": None}]),
        ("checkpoints", [{"step": 1, "path": "x"}]),
        ("checkpoints", [{"step": 1, "path": "x", "evaluation": "high"}]),
    ],
)
def test_a_manifest_of_wrong_types_is_named(run: Run, key: str, value: object) -> None:
    run.save(1, tree(), evaluation=0.0)
    manifest = json.loads((run.path / "run.json").read_text())
    manifest[key] = value
    if value == "gone":
        del manifest[key]
    (run.path / "run.json").write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=rf"run\.json: damaged manifest: {key}"):
        Run.open(run.path)
    (run.path / "run.json").write_text("3")
    with pytest.raises(UserError, match="damaged manifest: not an object"):
        Run.open(run.path)


@pytest.mark.parametrize(
    "change",
    [
        {"parts": {"policy": 3}},
        {"parts": []},
        {"parts": {"policy": [{"name": "w"}]}},
        {"parts": {"policy": [{"name": "w", "shape": "3", "dtype": "float32", "sha256": ""}]}},
        {"meta": None},
    ],
)
def test_an_index_of_wrong_types_is_damage(run: Run, change: dict) -> None:
    path = run.save(1, tree())
    index = json.loads((path / "index.json").read_text())
    (path / "index.json").write_text(json.dumps({**index, **change}))
    with pytest.raises(UserError, match=r"index\.json: damaged checkpoint index"):
        run.restore("latest", tree(), fall_back=True)
