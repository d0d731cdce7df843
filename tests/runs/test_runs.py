"""Run folders: atomic checkpoints, latest and best by the manifest, damage told from difference."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import cli, config, runs
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.runs import Run, checkpoints
from tests.runs.small_runs import Moments, same_bits, tree


def test_folder_holds_settings_command_and_versions(run: Run) -> None:
    assert run.path.parent.name == "Pendulum" and run.path.name.endswith("_t")
    assert (run.path / "command.txt").read_text() == "main --task Pendulum\n"
    manifest = json.loads((run.path / "run.json").read_text())
    assert {"python", "jax", "mujoco", "numpy"} <= set(manifest["versions"])
    assert manifest["status"] == "running" and len(manifest["git"]["commit"]) == 40
    assert Run.open(run.path).config == config.load("Pendulum")


def test_folders_of_the_same_second_do_not_collide(tmp_path: Path) -> None:
    made = [Run.create(tmp_path, "Ant", "", config.load("Ant"), "") for _ in range(3)]
    assert len({run.path for run in made}) == 3
    assert runs.latest_run(tmp_path, "Ant", with_checkpoint=False).path == made[-1].path


def test_the_best_is_that_of_the_newest_run_that_trained(tmp_path: Path) -> None:
    made = [Run.create(tmp_path, "Ant", "", config.load("Ant"), "") for _ in range(3)]
    for run, step, score in zip(made, (8, 8, 0), (98.5, 7.25, 300.0), strict=True):
        run.save(step, tree(1), evaluation=score)
    path, run_ = cli.find_checkpoint("best", "Ant", str(tmp_path))
    assert run_ is not None and run_.path == made[1].path
    of_all = cli.origin(path, run_, str(tmp_path))
    assert (
        of_all == f"run {made[1].path.name}, return 7.25, newest that trained, of 3 runs; --checkpoint RUN for another"
    )
    assert cli.origin(path, run_) == f"run {made[1].path.name}, return 7.25"
    assert cli.find_checkpoint("latest", "Ant", str(tmp_path))[0].parents[1] == made[2].path


def test_checkpoint_round_trip_is_bitwise(run: Run) -> None:
    run.save(12, tree(1), meta={"round": 3})
    restored, meta = Run.open(run.path).restore("latest", jax.eval_shape(lambda: tree(2)))
    assert same_bits(restored, tree(1)) and meta == {"round": 3}
    assert isinstance(restored["state"], Moments)


def test_one_entry_can_be_restored_alone(run: Run) -> None:
    run.save(1, tree(1))
    part, _ = run.restore("latest", {"policy": tree(2)["policy"]})
    assert same_bits(part["policy"], tree(1)["policy"])
    inner, _ = run.restore("latest", {"policy.w": tree(2)["policy"]["w"]})
    assert same_bits(inner["policy.w"], tree(1)["policy"]["w"])


def test_latest_and_best_come_from_the_manifest(run: Run) -> None:
    # 1000 sorts before 64 as text, and the best is neither the newest nor the one with the largest number
    for step, evaluation in ((64, -5.0), (128, -1.0), (1000, -3.0), (1024, None), (2000, float("nan")), (2048, -2.0)):
        run.save(step, {"x": jnp.int32(step)}, evaluation=evaluation)
    opened = Run.open(run.path)
    assert (opened.manifest["latest"], opened.manifest["best"]) == (2048, 128)
    for which, step in (("latest", 2048), ("best", 128), (2000, 2000), ("2000", 2000)):
        assert int(opened.restore(which, {"x": jnp.int32(0)})[0]["x"]) == step
    assert [c["step"] for c in opened.checkpoints] == [128, 1024, 2000, 2048]  # the newest three and the best
    assert len(list((run.path / "checkpoints").iterdir())) == 4


def test_evaluations_of_something_else_no_longer_compete_for_best(run: Run) -> None:
    """Under logs each round is evaluated on physics of its own: of 9, 5 and 7 the last is best."""
    rows = ((1, 9.0, False, 1), (2, 5.0, True, 2), (3, 7.0, True, 3), (4, 6.0, False, 3))
    for step, evaluation, supersede, best in rows:
        run.save(step, tree(), evaluation=evaluation, supersede=supersede)
        assert Run.open(run.path).manifest["best"] == best


def test_newest_run_is_by_creation_not_by_name(tmp_path: Path) -> None:
    first, second = (Run.create(tmp_path, "Ant", name, config.load("Ant"), "") for name in ("z", "a"))
    for r in (first, second):
        r.save(1, tree())
    first.path.rename(first.path.with_name("9999-12-31_23-59-59_z"))
    assert runs.latest_run(tmp_path, "Ant").path == second.path


def test_a_run_without_checkpoints_says_so(run: Run) -> None:
    with pytest.raises(UserError, match="no checkpoint yet"):
        run.restore("latest", {})
    run.save(3, tree())
    with pytest.raises(UserError, match="no checkpoint was evaluated"):
        run.checkpoint("best")
    with pytest.raises(UserError, match=r"no checkpoint 9.*steps 3"):
        run.checkpoint(9)
    with pytest.raises(UserError, match="no run of 'Cartpole'"):
        runs.latest_run(run.path.parents[1], "Cartpole")


def test_leftovers_of_a_kill_are_ignored_and_swept(run: Run) -> None:
    run.save(1, tree(1))
    folder = run.path / "checkpoints"
    (folder / "000000002.123.tmp").mkdir()  # killed while writing
    (folder / "000000003").mkdir()  # killed between the rename and the manifest
    (run.path / ".run.json.77.tmp").write_text('{"half')
    opened = Run.open(run.path)
    assert opened.manifest["latest"] == 1
    opened.save(3, tree(3))
    assert same_bits(opened.restore("latest", tree(0))[0], tree(3))
    assert sorted(p.name for p in folder.iterdir()) == sorted(Path(c["path"]).name for c in opened.checkpoints)


def test_same_step_again_replaces_the_old_one(run: Run) -> None:
    run.save(5, tree(1), evaluation=1.0)
    run.save(5, tree(2), evaluation=0.5)
    assert len(run.checkpoints) == 1
    assert same_bits(run.restore("best", tree(0))[0], tree(2))


def damage(path: Path) -> None:
    """Flip bytes in the middle of every data file."""
    for file in [f for f in path.rglob("*") if f.is_file() and f.parent.name == "d"]:
        content = bytearray(file.read_bytes())
        middle = len(content) // 2
        content[middle : middle + 8] = bytes(255 - b for b in content[middle : middle + 8])
        file.write_bytes(content)


@pytest.mark.parametrize("how", ["flip", "truncate", "delete", "no index", "index is no JSON"])
def test_damage_is_one_clear_error_and_resume_falls_back(run: Run, how: str, capsys: pytest.CaptureFixture) -> None:
    run.save(1, tree(1), evaluation=0.0)
    path = run.save(2, tree(2), evaluation=1.0)
    if how == "flip":
        damage(path / "policy")
    elif how == "index is no JSON":
        (path / "index.json").write_text("{")
    elif how == "no index":
        (path / "index.json").unlink()
    else:
        for file in [f for f in (path / "policy").rglob("*") if f.is_file()]:
            file.unlink() if how == "delete" else file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(UserError, match=f"{path.name}.*Use another checkpoint of the run: 1"):
        run.restore("latest", tree(0))
    restored, _ = run.restore("latest", tree(0), fall_back=True)
    assert same_bits(restored, tree(1))
    assert "going on from the checkpoint of step 1" in capsys.readouterr().err
    assert Run.open(run.path).manifest["best"] == 1


def test_a_flip_anywhere_in_the_data_is_noticed(run: Run) -> None:
    path = run.save(1, {"x": jnp.arange(4000.0)})
    damage(path / "x")
    with pytest.raises(UserError, match="damaged checkpoint.*start the run again"):
        run.restore("latest", {"x": jnp.arange(4000.0)}, fall_back=True)


def test_another_structure_names_the_leaf(run: Run) -> None:
    run.save(1, tree(1))
    with pytest.raises(UserError, match=r"policy\.w\.0 is float32\[3, 5\] in the checkpoint, but float32\[3, 6\]"):
        run.restore("latest", tree(0, width=6), fall_back=True)
    with pytest.raises(UserError, match="has no 'critic'; it has"):
        run.restore("latest", {"critic": jnp.zeros(1)})
    with pytest.raises(UserError, match=r"policy\.b is absent in the checkpoint"):
        run.restore("latest", {"policy": {**tree()["policy"], "b": jnp.zeros(2)}})


SPACE = ParameterSpace(
    [Parameter("mass", 1.0, 0.5, 2.0), Parameter("gain", 1.0, 0.5, 2.0, prior="gaussian", mean=1.2, sd=0.1)]
)


def test_a_posterior_keeps_its_coordinates(run: Run) -> None:
    """Numbers in unit coordinates mean nothing without chart, box and priors: other ones are refused, none assumed."""
    probit = Distribution.from_unit(SPACE, [0.0], [[1.5, 1.9]], [np.eye(2) * 0.1], chart="probit")
    path = run.save(1, {"state": {"domain": probit}})
    assert checkpoints.chart(path, "state.domain") == "probit"
    like = Distribution.prior(SPACE, 1, "probit")
    again = run.restore(1, {"state.domain": jax.eval_shape(lambda: like)})[0]["state.domain"]
    assert again.chart == "probit"
    np.testing.assert_array_equal(again.mean(), probit.mean())
    for own, message in (
        (Distribution.prior(SPACE, 1), "state.domain is in probit coordinates, but they are plain here: use the task"),
        (_over(high=3.0), r"has mass in \[0.5, 2.0\], but its range here is \[0.5, 3.0\]"),
        (_over(prior="loguniform"), "has the prior uniform of mass, but its prior here is loguniform"),
    ):
        with pytest.raises(UserError, match=message):
            run.restore(1, {"state.domain": own})
    index = json.loads((path / "index.json").read_text())
    for key in ("coordinates", "sha256"):  # as before there were any
        index.pop(key)
    (path / "index.json").write_text(json.dumps(index))
    assert checkpoints.chart(path, "state.domain") is None
    run.restore(1, {"state.domain": like})


def _over(**changes: Any) -> Distribution:
    mass = dataclasses.replace(SPACE.parameters[0], **changes)
    return Distribution.prior(ParameterSpace([mass, SPACE.parameters[1]]), 1, "probit")


def test_names_cannot_leave_the_folder() -> None:
    with pytest.raises(UserError, match="name = '../x'"):
        config.load("Ant", overrides=["name=../x"])
