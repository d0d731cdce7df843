"""Event files are read back byte by byte: what was written is there, and a resumed run repeats no step."""

import io

import numpy as np
import pytest
from PIL import Image

from bayessim_mjx.monitor.writer import TensorBoard, event_files, purge, records


def rows(folder):
    """All (tag, step, value) of a folder, in the order a reader meets them."""
    out = []
    for path in event_files(folder):
        for _, event in records(path):
            for value in event.summary.value:
                kind = value.WhichOneof("value")
                out.append((value.tag, event.step, getattr(value, kind)))
    return out


def scalars(folder):
    return [(tag, step, value) for tag, step, value in rows(folder) if isinstance(value, float)]


def test_scalars_come_back_and_missing_ones_are_left_out(tmp_path):
    import jax.numpy as jnp

    with TensorBoard(tmp_path) as writer:
        writer.scalars(3, {"a": 1.5, "b": jnp.float32(2.0), "c": np.array([4]), "nan": float("nan"), "none": None})
        writer.scalars(4, {"mean": -7}, prefix="Train/")
    assert scalars(tmp_path) == [("a", 3, 1.5), ("b", 3, 2.0), ("c", 3, 4.0), ("Train/mean", 4, -7.0)]


def test_infinity_is_written(tmp_path):
    with TensorBoard(tmp_path) as writer:
        writer.scalars(0, {"log_gain": -np.inf})
    assert scalars(tmp_path) == [("log_gain", 0, -np.inf)]


def test_a_vector_is_no_scalar(tmp_path):
    with TensorBoard(tmp_path) as writer, pytest.raises(ValueError, match=r"'loss' has shape \(2,\)"):
        writer.scalars(0, {"loss": np.zeros(2)})


def test_code_is_kept_line_for_line(tmp_path):
    with TensorBoard(tmp_path) as writer:
        writer.text("BayesSim/cfg", "ppo:\n  num_envs: 8", code=True)
    [(tag, step, tensor)] = rows(tmp_path)
    assert (tag, step) == ("BayesSim/cfg/text_summary", 0)
    assert tensor.string_val[0].decode() == "    ppo:\n      num_envs: 8"


def test_figure_is_a_png_that_is_kept_and_the_figure_is_closed(tmp_path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3, 2), dpi=100)
    figure.subplots().plot([0, 1])
    with TensorBoard(tmp_path / "tb", media=tmp_path / "media") as writer:
        writer.figure("BayesSim/posterior", figure, 2)
    [(tag, step, image)] = rows(tmp_path / "tb")
    assert (tag, step, image.width, image.height) == ("BayesSim/posterior", 2, 300, 200)
    assert Image.open(io.BytesIO(image.encoded_image_string)).size == (300, 200)
    assert (tmp_path / "media" / "BayesSim_posterior_000002.png").read_bytes() == image.encoded_image_string
    assert not figure.axes


def test_video_is_a_gif_with_every_frame_and_an_mp4(tmp_path):
    frames = np.zeros((7, 24, 32, 3), np.uint8)
    for t, frame in enumerate(frames):
        frame[:, 4 * t : 4 * t + 4] = (250, 120, 0)
    with TensorBoard(tmp_path) as writer:
        writer.video("SurrogateReal/video", frames, 25, 1)
        writer.video("SurrogateReal/video", None, 25, 2)
    [(tag, step, image)] = rows(tmp_path)
    gif = Image.open(io.BytesIO(image.encoded_image_string))
    assert (tag, step, gif.format, gif.n_frames, gif.size) == ("SurrogateReal/video", 1, "GIF", 7, (32, 24))
    assert gif.info["duration"] == 40
    gif.seek(5)
    assert np.abs(np.asarray(gif.convert("RGB"), int) - frames[5]).max() <= 8
    mp4 = tmp_path / "media" / "SurrogateReal_video_000001.mp4"
    assert mp4.read_bytes()[4:8] == b"ftyp"


def test_resume_repeats_no_step(tmp_path):
    with TensorBoard(tmp_path) as writer:
        for step in range(5):
            writer.scalars(step, {"loss": float(step), "old/only": 1.0})
    with TensorBoard(tmp_path, purge_step=3) as writer:
        for step in range(3, 6):
            writer.scalars(step, {"loss": 100.0 + step})
    assert [(s, v) for tag, s, v in scalars(tmp_path) if tag == "loss"] == [
        (0, 0.0), (1, 1.0), (2, 2.0), (3, 103.0), (4, 104.0), (5, 105.0),
    ]  # fmt: skip
    assert [s for tag, s, _ in scalars(tmp_path) if tag == "old/only"] == [0, 1, 2]


def test_writers_of_one_second_share_no_file(tmp_path):
    for step in range(3):
        with TensorBoard(tmp_path) as writer:
            writer.scalars(step, {"loss": 0.0})
    assert len(event_files(tmp_path)) == 3
    assert [step for _, step, _ in scalars(tmp_path)] == [0, 1, 2]


def test_purge_by_prefix_where_tags_count_different_things(tmp_path):
    with TensorBoard(tmp_path) as writer:
        for step in range(4):
            writer.scalars(step, {"BayesSim/gain": 0.0})
            writer.scalars(100 * step, {"Train/reward": 0.0})
    assert purge(tmp_path, {"BayesSim": 2, "Train": 300}) == 3
    kept = scalars(tmp_path)
    assert [s for tag, s, _ in kept if tag == "BayesSim/gain"] == [0, 1]
    assert [s for tag, s, _ in kept if tag == "Train/reward"] == [0, 100, 200]


def test_a_file_cut_short_by_a_kill_is_read_up_to_the_cut(tmp_path):
    with TensorBoard(tmp_path) as writer:
        for step in range(5):
            writer.scalars(step, {"loss": 0.0})
    [path] = event_files(tmp_path)
    path.write_bytes(path.read_bytes()[:-5])
    assert [step for _, step, _ in scalars(tmp_path)] == [0, 1, 2, 3]
    purge(tmp_path, 2)
    assert [step for _, step, _ in scalars(tmp_path)] == [0, 1]


def test_tensorboard_agrees(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    with TensorBoard(tmp_path) as writer:
        for step in range(5):
            writer.scalars(step, {"loss": float(step)})
    with TensorBoard(tmp_path, purge_step=3) as writer:
        writer.scalars(3, {"loss": 30.0})
        writer.video("video", np.random.default_rng(0).integers(0, 255, (3, 8, 8, 3)).astype(np.uint8), 10, 3)
    events = accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss")] == [(0, 0), (1, 1), (2, 2), (3, 30)]
    assert events.Images("video")[0].encoded_image_string[:4] == b"GIF8"
