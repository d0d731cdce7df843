"""What stands beside TensorBoard: lines of text that a resumed run does not repeat, and Weights & Biases."""

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from bayessim_mjx.config import load
from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor import writers
from bayessim_mjx.monitor.writer import TensorBoard, event_files
from bayessim_mjx.monitor.writers import Lines, opened, read


@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_numbers_come_back_and_missing_ones_are_left_out(kind, tmp_path):
    writer = Lines(tmp_path / f"scalars.{kind}")
    writer.scalars(3, {"a": 1.5, "b": np.float32(0.25), "nan": float("nan"), "none": None, "much": np.inf})
    writer.scalars(4, {'say, "x"': -7}, prefix="Train/")
    writer.close()
    rows = [(r["step"], r["tag"], r["value"]) for r in read(tmp_path / f"scalars.{kind}")]
    assert rows == [(3, "a", 1.5), (3, "b", 0.25), (3, "much", np.inf), (4, 'Train/say, "x"', -7.0)]


def test_lines_are_json_and_csv_as_others_read_them(tmp_path):
    for kind in ("csv", "jsonl"):
        writer = Lines(tmp_path / f"x.{kind}")
        writer.scalars(1, {"a": 2, "b": np.inf})
        writer.close()
    table = (tmp_path / "x.csv").read_text().splitlines()
    assert table[0] == "step,tag,value,time" and table[1].startswith("1,a,2.0,")
    first, second = map(json.loads, (tmp_path / "x.jsonl").read_text().splitlines())
    assert first | {"time": 0} == {"step": 1, "tag": "a", "value": 2.0, "time": 0} and second["value"] == "inf"


@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_a_resumed_run_repeats_no_step_and_drops_half_a_line(kind, tmp_path):
    path = tmp_path / f"scalars.{kind}"
    writer = Lines(path)
    for step in range(5):
        writer.scalars(step, {"Train/a": step, "BayesSim/b": step})
    writer.close()
    with path.open("a") as file:
        file.write("5,Tra")  # the run was killed
    writer = Lines(path, {"BayesSim": 2, "Train": 4})
    writer.scalars(4, {"Train/a": 40})
    writer.close()
    found = [(r["tag"], r["step"], r["value"]) for r in read(path)]
    assert sorted(found) == sorted(
        [("Train/a", s, float(s)) for s in range(4)] + [("BayesSim/b", s, float(s)) for s in range(2)]
        + [("Train/a", 4, 40.0)]
    )  # fmt: skip


def test_tensorboard_stands_beside_them(tmp_path):
    assert isinstance(opened(tmp_path / "rl"), TensorBoard)
    several = opened(tmp_path / "rl", more=("jsonl", "csv"))
    several.scalars(1, {"a": 2.0})
    several.text("note", "hello")
    several.flush()
    assert [p.name for p in sorted((tmp_path / "rl").glob("scalars.*"))] == ["scalars.csv", "scalars.jsonl"]
    assert read(tmp_path / "rl" / "scalars.csv")[0]["value"] == 2.0 and event_files(tmp_path / "rl")
    several.close()
    several.close()


class Fake(types.ModuleType):
    """What of wandb is used; remembers."""

    Error = RuntimeError

    def __init__(self):
        super().__init__("wandb")
        self.begun, self.logged, self.finished, self.config = [], [], 0, types.SimpleNamespace(update=self.configured)

    def init(self, **given):
        self.begun.append(given)
        return types.SimpleNamespace(
            id=given["id"] or "run-7", log=self.logged.append, config=self.config, define_metric=lambda *_, **__: None,
            finish=self.finish,
        )  # fmt: skip

    def Image(self, picture):
        return ("picture", picture.size)

    def Video(self, path, format):
        return ("video", format, Path(path).read_bytes()[4:8])

    def configured(self, values, allow_val_change):
        self.logged.append(values)

    def finish(self):
        self.finished += 1


def test_wandb_has_one_run_for_a_folder_and_goes_on_with_it(tmp_path, monkeypatch):
    fake = Fake()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setenv("WANDB_PROJECT", "arm")
    folder = tmp_path / "2026_run"
    folder.mkdir()
    for session in range(2):
        pair = [opened(folder / name, more=("wandb",), run=folder) for name in ("rl", "bsim")]
        pair[0].scalars(7 + session, {"Train/a": 1.0, "none": None})
        pair[1].text("cfg", "seed: 3", code=True)
        for writer in pair:
            writer.close()
    assert [g["id"] for g in fake.begun] == [None, "run-7"] and fake.finished == 2
    assert {(g["project"], g["name"], g["resume"]) for g in fake.begun} == {("arm", "2026_run", "allow")}
    assert fake.logged[:2] == [{"rl/Train/a": 1.0, "rl/step": 7}, {"cfg": {"seed": 3}}]


def test_wandb_gets_pictures_and_videos(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    fake = Fake()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    writer, figure = opened(tmp_path / "bsim", more=("wandb",), run=tmp_path), Figure(figsize=(3, 2), dpi=100)
    writer.figure("BayesSim/posterior", figure, 2)
    writer.video("SurrogateReal/video", np.zeros((4, 24, 32, 3), np.uint8), 25, 2)
    writer.video("SurrogateReal/video", None, 25, 3)
    writer.close()
    assert fake.logged == [
        {"bsim/BayesSim/posterior": ("picture", (300, 200)), "bsim/step": 2},
        {"bsim/SurrogateReal/video": ("video", "mp4", b"ftyp"), "bsim/step": 2},
    ]


def test_a_video_that_could_not_be_saved_is_not_logged(tmp_path, monkeypatch):
    """Neither as a file that is missing nor as the one before it."""
    from bayessim_mjx.monitor import video

    fake, saved = Fake(), []
    monkeypatch.setitem(sys.modules, "wandb", fake)
    writer = opened(tmp_path / "rl", more=("wandb",), run=tmp_path)
    save = video.save
    monkeypatch.setattr(video, "save", lambda *given: save(*given) if saved.append(given) or len(saved) == 1 else False)
    for step in (1, 2):
        writer.video("Train/video", np.zeros((4, 24, 32, 3), np.uint8), 25, step)
    writer.close()
    steps = [row["rl/step"] for row in fake.logged]
    assert steps == [1] and any(given[1].name.startswith(".wandb") for given in saved)


def test_wandb_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(UserError, match=r"pip install 'bayessim-mjx\[wandb\]'"):
        opened(tmp_path, more=("wandb",))


def test_wandb_without_a_login_is_told_in_one_line(tmp_path, monkeypatch):
    fake = Fake()
    monkeypatch.setitem(sys.modules, "wandb", fake)

    def init(**_):
        raise fake.Error("No API key configured")

    fake.init = init
    with pytest.raises(UserError, match="wandb: No API key configured; WANDB_MODE=offline"):
        opened(tmp_path, more=("wandb",))


def test_the_real_wandb_goes_on_with_its_run(tmp_path, monkeypatch):
    """Offline: two sessions of one run, with all kinds of things to show."""
    pytest.importorskip("wandb")
    from matplotlib.figure import Figure

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    known = []
    for session in range(2):
        writer = opened(tmp_path / "rl", more=("wandb",), run=tmp_path)
        writer.text("cfg", "seed: 3", code=True)
        writer.scalars(session, {"Train/a": 1.5, "none": None})
        writer.figure("posterior", Figure(figsize=(1, 1)), session)
        writer.video("video", np.zeros((4, 24, 32, 3), np.uint8), 25, session)
        writer.close()
        known.append((tmp_path / "wandb_id.txt").read_text().strip())
    assert known[0] == known[1]
    sessions = list((tmp_path / "wandb").glob(f"offline-run-*-{known[0]}/run-{known[0]}.wandb"))
    assert len(sessions) == 2
    for file in sessions:
        held = file.read_bytes()
        assert all(word in held for word in (b"rl/Train/a", b"rl/posterior", b"rl/video", b"seed"))
        assert {p.suffix for p in file.parent.rglob("rl/*")} >= {".png", ".mp4"}


def test_a_kind_that_there_is_not_is_refused():
    assert load("Pendulum", overrides=["monitor.writers=[csv]"]).monitor.writers == ("csv",)
    with pytest.raises(UserError, match="monitor.writers.*jsonl, csv, wandb"):
        load("Pendulum", overrides=["monitor.writers=[excel]"])
    assert writers.PLAIN == ("step", "tag", "value", "time")
