"""Videos show something, keep real time, and never stop a run where there is no OpenGL."""

import warnings

import mujoco
import numpy as np
import pytest

from bayessim_mjx.monitor import rendering, video
from bayessim_mjx.monitor.camera import reach, view_of

PENDULUM = """<mujoco><worldbody><body name="pole"><joint type="hinge" axis="0 1 0"/>
<geom type="capsule" size=".05" fromto="0 0 0 0 0 1" rgba=".9 .1 .1 1"/></body></worldbody></mujoco>"""
CAMERA = '<camera name="side" pos="0 -2 1" xyaxes="1 0 0 0 .4 1"/>'
FLOATING = f"""<mujoco><worldbody><geom type="plane" size="5 5 .1"/>{CAMERA}
<body name="torso" pos="0 0 1"><freejoint/><geom size=".2" rgba=".1 .9 .1 1"/></body></worldbody></mujoco>"""


def model(xml):
    return mujoco.MjModel.from_xml_string(xml)


def rendered(*arguments, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frames = video.record(*arguments, **options)
    if frames is None:
        said = [str(w.message) for w in caught]
        assert any("no video" in text for text in said)
        assert not any("rendering failed" in text for text in said), said  # with OpenGL there are pictures
        pytest.skip("no OpenGL here")
    return frames


def red(frame):
    """Where the red pole is: mean (x, y) in pixels from the picture's middle, y upwards, and how many pixels."""
    y, x = np.nonzero((frame[..., 0] > 90) & (frame[..., 0] > 2.0 * frame[..., 1]))
    return x.mean() - frame.shape[1] / 2, frame.shape[0] / 2 - y.mean(), len(x)


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(rendering, "_warned", set())


def test_the_pole_is_seen_where_it_points():
    up, right = 0.0, np.pi / 2  # a turn about +y carries the pole from +z to +x
    frames = rendered(model(PENDULUM), np.array([[up], [right], [np.pi], [-right]]), width=160, height=120)
    assert frames.shape == (4, 120, 160, 3) and frames.dtype == np.uint8
    (_, y0, n0), (x1, y1, _), (_, y2, _), (x3, *_) = map(red, frames)
    assert n0 > 100 and y0 > 15 and x1 > 15 and abs(y1) < 12 and y2 < -15 and x3 < -15
    assert frames[0].std() > 5 and frames[0, 0].mean() > 150  # a light sky, not black


def test_grid_text_and_real_time(tmp_path):
    worlds = [np.zeros((21, 1)), np.ones((11, 1)), np.zeros((21, 1))]
    texts = ["real", {"mass": 1.234567}, None]
    path = tmp_path / "videos" / "a.gif"
    frames = rendered(
        model(PENDULUM), worlds, path=path, fps=10, dt=0.05, width=96, height=80, overlay_text=texts, camera=None
    )
    assert frames.shape == (10, 160, 192, 3)  # 21 rows of 0.05 s: ten frames of 0.1 s, in a 2 x 2 grid
    assert (frames[:, 80:, 96:] == 255).all()  # the fourth place is empty
    assert frames[0, :20, :40].min() < 80  # letters
    assert path.read_bytes()[:4] == b"GIF8"


def test_cameras_by_name_number_and_default():
    floating = model(FLOATING)
    qpos, data = np.tile(floating.qpos0, (2, 1)), mujoco.MjData(floating)
    for camera in ("side", 0, None):
        assert view_of(floating, data, qpos, camera, 4 / 3).fixedcamid == 0
    with pytest.raises(ValueError, match="no camera 'top'; it has \\['side'\\]"):
        view_of(floating, data, qpos, "top", 4 / 3)
    free = model(FLOATING.replace(CAMERA, ""))
    view = view_of(free, mujoco.MjData(free), qpos, None, 4 / 3)
    assert view.type == mujoco.mjtCamera.mjCAMERA_TRACKING and view.trackbodyid == free.body("torso").id
    assert 0.4 < view.distance < 2.0  # near the robot, whatever the size of the floor
    hinge = model(PENDULUM)
    assert view_of(hinge, mujoco.MjData(hinge), np.zeros((1, 1)), None, 4 / 3).azimuth == 90  # face on


def test_larger_than_the_models_buffer_and_the_model_is_left_alone():
    pendulum = model(PENDULUM)
    before = pendulum.vis.global_.offwidth, float(pendulum.vis.headlight.ambient[0])
    assert rendered(pendulum, np.zeros((1, 1)), width=700, height=20).shape == (1, 20, 700, 3)
    assert (pendulum.vis.global_.offwidth, float(pendulum.vis.headlight.ambient[0])) == before


def test_single_pictures_have_one_point_of_view_and_others_may_be_made_between_them():
    """Asked for one by one, the pole turns about the middle of the picture, as in a film of all poses."""
    rendered(model(PENDULUM), np.zeros((1, 1)), width=16, height=12)  # skipped where no OpenGL works
    renderer = rendering.Renderer.of(model(PENDULUM), 160, 120)
    view, seen = renderer.view(reach(renderer.model)), []
    for angle in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        seen.append(red(renderer.frames(np.array([[angle]]), view)[0]))
        rendered(model(FLOATING), np.tile(model(FLOATING).qpos0, (1, 1)), width=16, height=12)
    (x0, y0, _), (x1, y1, _), (x2, y2, _), (x3, y3, _) = seen
    np.testing.assert_allclose([x0, x2, y1, y3, x1 + x3], 0, atol=1.5)
    np.testing.assert_allclose([y0, -y2], x1, atol=6)  # the camera looks down on it a little
    assert x1 > 15
    assert renderer.close.alive
    renderer.close()


def test_poses_that_a_camera_is_fitted_to_reach_every_limit():
    limited = "<mujoco><worldbody><body><joint type='slide' range='-1 2' limited='true'/><geom size='.1'/></body>"
    poses = reach(model(limited + "</worldbody></mujoco>"))
    assert poses.shape == (21, 1) and (poses.min(), poses.max()) == (-1, 2)
    assert np.isin([-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi], reach(model(PENDULUM))).all()
    free = model(FLOATING)
    np.testing.assert_array_equal(reach(free), np.tile(free.qpos0, (21, 1)))


@pytest.mark.parametrize("off", ["disable", "off"])
def test_switched_off_means_none_and_one_warning(monkeypatch, off):
    monkeypatch.setenv("MUJOCO_GL", off)
    with pytest.warns(UserWarning, match="MUJOCO_GL"):
        assert video.record(model(PENDULUM), np.zeros((2, 1))) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert video.record(model(PENDULUM), np.zeros((2, 1))) is None  # said once


def test_without_opengl_training_goes_on(monkeypatch):
    def fail(*_):
        raise ImportError("libEGL.so not found")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering, "_make_context", fail)
    with pytest.warns(UserWarning, match="libEGL.so not found"):
        assert video.record(model(PENDULUM), np.zeros((2, 1))) is None


def test_the_users_choice_is_the_only_one_tried(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert rendering.backends() == ["osmesa"]
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(rendering.platform, "system", lambda: "Linux")
    assert rendering.backends() == ["egl", "osmesa"]


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match=r"qpos has shape \(2, 3\); expected \[T, 1\]"):
        video.record(model(PENDULUM), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="allowed endings: .mp4, .gif"):
        video.save(np.zeros((1, 4, 4, 3), np.uint8), "a.avi", 25)


def test_odd_sizes_become_an_mp4(tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    frames = np.random.default_rng(0).integers(0, 255, (6, 33, 47, 3)).astype(np.uint8)
    assert video.save(frames, tmp_path / "a.mp4", 25)
    assert imageio.imread(tmp_path / "a.mp4", plugin="FFMPEG").shape == (6, 32, 46, 3)


def letters(part):
    """How many dark pixels there are."""
    return int((part.max(-1) < 90).sum())


def test_title_and_captions_stand_on_a_strip_below_the_picture():
    blank = np.full((3, 240, 320, 3), 200, np.uint8)
    frames = video.underline(blank, 16, "Pendulum, round 2", ["0.00 s    return 0", "0.10 s    return -3", ""])
    assert frames.shape == (3, 256, 320, 3) and (frames[:, :240] == 200).all()  # nothing of the picture is hidden
    title, caption = frames[:, 240:, :160], frames[:, 240:, 160:]
    assert all(letters(t) > 40 for t in title) and (title[0] == title[1]).all()
    assert letters(caption[0]) > 40 and (caption[0] != caption[1]).any() and letters(caption[2]) == 0
    long = video.underline(blank, 16, 20 * "long ", ["9.99 s    return -1234.5    terminated"] * 3)
    assert letters(long[0, 240:, :4]) == 0 == letters(long[0, 240:, -4:])  # smaller letters, both ends free


def test_captions_follow_the_rows_that_are_picked(monkeypatch):
    drawn = {}
    monkeypatch.setattr(video, "render", lambda m, worlds, w, h, *_: [np.zeros((len(worlds[0]), h, w, 3), np.uint8)])
    monkeypatch.setattr(video, "underline", lambda frames, *rest: drawn.setdefault("rest", rest) and frames)
    video.record(model(PENDULUM), np.zeros((5, 1)), fps=5, dt=0.1, title="P", captions=list("abcde"))
    assert drawn["rest"] == (15, "P", ["a", "c"])  # half a second at 5 frames a second: seconds 0 and 0.2
    with pytest.raises(ValueError, match="2 captions for 1 world"):
        video.record(model(PENDULUM), np.zeros((5, 1)), captions=["a", "b"])


class Env:
    """Stands for an environment of our own; its episode is the trajectory below."""

    dt, physics = 0.1, None

    def marks(self, qpos, observation):
        return np.tile(observation[:, None, :1], (1, 1, 7))


def episode(monkeypatch, terminated):
    from types import SimpleNamespace

    from bayessim_mjx.monitor import film

    rows = SimpleNamespace(
        qpos=np.arange(6.0)[None, :, None],
        observation=np.arange(6.0)[None, :, None],
        reward=np.array([[1.0, 2.0, 0.5, 0.0, 0.0]]),
        valid=np.array([[1.0, 1.0, 1.0, 0.0, 0.0]]),
        terminated=np.array([[0.0, 0.0, float(terminated), 0.0, 0.0]]),
        truncated=np.zeros((1, 5)),
    )
    monkeypatch.setattr(film, "rollout", lambda *_: rows)
    monkeypatch.setattr(film.jax.tree, "map", lambda f, t: SimpleNamespace(**{k: f(v) for k, v in vars(t).items()}))
    policy = SimpleNamespace(replace=lambda **_: None)
    return film.motion(Env(), policy, None, np.zeros(1), 5)


def test_a_film_counts_time_and_return_until_the_episode_ends(monkeypatch):
    shown = episode(monkeypatch, terminated=True)
    assert shown.qpos[:, 0].tolist() == [0, 1, 2, 3] and shown.total.tolist() == [0.0, 1.0, 3.0, 3.5]
    assert shown.captions() == [
        "0.00 s    return 0.00", "0.10 s    return 1.00", "0.20 s    return 3.00",
        "0.30 s    return 3.50    terminated",
    ]  # fmt: skip


def test_films_have_the_size_that_is_set_and_trainings_half_of_it(monkeypatch):
    from bayessim_mjx.config.settings import MonitorConfig
    from bayessim_mjx.monitor import film

    asked = []
    monkeypatch.setattr(video, "record", lambda m, qpos, path, **more: asked.append((len(qpos), more)))
    shown = episode(monkeypatch, terminated=True)
    for half in (False, True):
        film.frames(None, shown, MonitorConfig(), "Pendulum, surrogate real", {"mass": 2}, half=half)
    assert [(more["width"], more["height"]) for _, more in asked] == [(960, 720), (480, 360)]
    length, more = asked[0]
    assert more["mocap"].shape == (14, 1, 7) and more["mocap"][:, 0, 0].tolist() == [0, 1, 2, *11 * [3]]
    assert length == 4 + 10 == len(more["captions"])  # the last pose stays for a second
    assert more["overlay_text"] == {"mass": 2} and more["title"] == "Pendulum, surrogate real"


def test_what_a_task_marks_moves_with_it():
    marked = model(
        FLOATING.replace("</worldbody>", '<body name="goal" mocap="true"><geom size=".3"/></body></worldbody>')
    )
    qpos, marks = np.tile(marked.qpos0, (2, 1)), np.tile([[[0, 0, 1.0, 1, 0, 0, 0]]], (2, 1, 1))
    marks[1, 0, 2] = 50.0  # out of sight
    still, moved = rendered(marked, qpos, mocap=marks, width=80, height=60)
    assert (still != moved).any()
