"""`bayessim-mjx logs show`: the numbers behind the page by truths known beforehand, the page, and the MCAP file."""

import json
import re
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.logs import excited, views
from bayessim_mjx.logs.channel_units import units_of
from bayessim_mjx.logs.views import Sheet
from tests.logs.importing import model_of
from tests.logs.log_files import HEADER, rows, write

T = 0.01 * np.arange(2000)  # s


def sheet(**channels: np.ndarray) -> Sheet:
    return Sheet("run.csv", T, {name.replace("_", ":", 1): values for name, values in channels.items()})


def test_a_sine_is_one_line_of_the_spectrum() -> None:
    found = views.spectrum([sheet(qpos_a=0.3 * np.sin(2 * np.pi * 5 * T))], "qpos:a")
    assert found is not None
    frequency, density = found
    assert abs(frequency[np.argmax(density)] - 5) < 0.5
    power = np.sum(density**2) * (frequency[1] - frequency[0])
    assert power == pytest.approx(0.3**2 / 2, rel=0.1)  # Parseval


def test_noise_of_a_known_density() -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, len(T))
    found = views.spectrum([sheet(qpos_a=noise)], "qpos:a")
    assert found is not None  # sd^2 = density^2 times half the rate
    assert np.median(found[1]) == pytest.approx(0.1 / np.sqrt(50), rel=0.1)


def test_coverage_of_a_sine() -> None:
    place = 0.5 * np.sin(2 * np.pi * T)  # 20 turns in 20 s
    found = views.coverage([sheet(qpos_a=place)], "a", (-1.0, 1.0))
    assert found is not None
    assert found.range_share == pytest.approx(0.5, abs=0.01) and found.fastest == pytest.approx(np.pi, rel=0.01)
    assert abs(found.turns - 40) <= 1 and found.counts.sum() == len(T)
    # |cos| <= 0.02 in a share of 2 / pi asin(0.02) of the time
    assert found.rest == pytest.approx(2 / np.pi * np.arcsin(0.02), abs=0.01)


def test_parts_of_an_orientation_have_no_velocity_of_their_own() -> None:
    base = {f"qpos:root[{i}]": np.sin(T) for i in range(7)} | {f"qvel:root[{i}]": np.cos(T) for i in range(6)}
    own = Sheet("run.csv", T, base)
    assert views.velocity(own, "root[2]") is not None and views.velocity(own, "root[3]") is None
    ball = Sheet("run.csv", T, {f"qpos:ball[{i}]": np.sin(T) for i in range(4)} | {"qvel:ball[0]": np.cos(T)})
    assert views.velocity(ball, "ball[0]") is None


def test_a_joint_follows_its_own_command() -> None:
    rng = np.random.default_rng(1)
    one, two = np.cumsum(rng.normal(size=(2, len(T))), axis=1) * 0.1
    speed = np.convolve(one, [0.0, 0.5, 0.3])[: len(T)]
    found = excited.excitation([sheet(ctrl_u=one, ctrl_v=two, qpos_a=0 * T, qvel_a=speed)])
    assert found is not None and found.commands == ("u", "v")
    assert found.coherence[0, 0] > 0.95 and found.coherence[1, 0] < 0.4


def test_a_long_line_keeps_its_extremes() -> None:
    values = np.random.default_rng(0).normal(size=100_000)
    time, shown = views.thinned(np.arange(100_000.0), values, 500)
    assert len(shown) <= 502 and shown.max() == values.max() and shown.min() == values.min()
    assert (np.diff(time) > 0).all()


def logs(tmp_path: Path, count: int = 400) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    write(folder, rows(count), HEADER)
    return folder


def show(capsys: pytest.CaptureFixture, *argv: object) -> str:
    assert import_logs.main(["show", *map(str, argv)]) == 0
    return capsys.readouterr().out


def test_the_page_has_every_section_and_loads_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "page" / "show.html"
    show(capsys, logs(tmp_path), "--model", model_of(tmp_path), "--out", out)
    page = out.read_text()
    assert [f'id="{name}"' in page for name in ("time", "coverage", "excitation", "spectra", "rates", "columns")] == [
        True
    ] * 6
    own = page[page.rindex("</script>\n</head>") :]  # without plotly.js
    assert "1 log, 4.0 s of motion, 2 positions, 2 commands" in own
    assert not re.search(r"(?:src|href)=\"(?:https?:)?//", own)
    for text in re.findall(r'<script type="application/json">(.*?)</script>', own):
        assert json.loads(text)["data"]


def test_axes_have_the_units_of_the_model(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    show(capsys, logs(tmp_path), "--model", model_of(tmp_path), "--out", tmp_path / "show.html")
    text = (tmp_path / "show.html").read_text()
    for words in ("position shoulder (rad)", "velocity shoulder (rad/s)", "position (rad)", "velocity (rad/s)"):
        assert words in text


def test_units_of_channels() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
      <body name="base"><freejoint name="root"/><geom size=".1"/>
        <body><joint name="turn"/><geom size=".1"/></body>
        <body><joint name="rail" type="slide"/><geom size=".1"/></body>
      </body></worldbody><actuator><motor name="m" joint="turn"/><motor name="geared" joint="turn" gear="9"/>
      <position name="p" joint="rail" kp="5"/><velocity name="v" joint="turn" kv="2"/></actuator></mujoco>""")
    found = units_of(model)
    assert found["qpos:root[2]"] == "m" and "qpos:root[3]" not in found and found["qvel:root[5]"] == "rad/s"
    assert (found["qpos:turn"], found["qvel:rail"]) == ("rad", "m/s") and "effort:turn" not in found
    assert (found["ctrl:m"], found["ctrl:p"], found["ctrl:v"]) == ("N m", "m", "rad/s") and "ctrl:geared" not in found


def test_without_a_model_columns_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "show.html"
    said = show(capsys, logs(tmp_path), "--out", out)
    assert "--model" in said and "position shoulder" in out.read_text()


def test_a_large_log_makes_no_large_page(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from plotly.offline import get_plotlyjs

    show(capsys, logs(tmp_path, 60_000), "--model", model_of(tmp_path), "--out", tmp_path / "show.html")
    assert (tmp_path / "show.html").stat().st_size < len(get_plotlyjs()) + 2e6


def test_nothing_to_show_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert import_logs.main(["show", str(tmp_path / "nowhere")]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_a_missing_package_is_named_before_the_page_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    out = tmp_path / "show.html"
    assert import_logs.main(["show", str(logs(tmp_path)), "--out", str(out), "--mcap", str(tmp_path / "a.mcap")]) == 2
    assert "pip install 'bayessim-mjx[logs]'" in capsys.readouterr().err and not out.exists()


def test_mcap_holds_every_row(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    reader = pytest.importorskip("mcap.reader", reason="the extra [logs] is not installed")
    path = tmp_path / "logs.mcap"
    show(capsys, logs(tmp_path), "--model", model_of(tmp_path), "--out", tmp_path / "show.html", "--mcap", path)
    with path.open("rb") as file:
        found = [(c.topic, m.log_time, json.loads(m.data)) for _, c, m in reader.make_reader(file).iter_messages()]
    places = [(t, row) for topic, t, row in found if topic == "/run/positions"]
    assert len(places) == 400 and places[100][0] == 1_000_000_000
    assert places[100][1]["shoulder"] == pytest.approx(0.5 * np.sin(3.0), abs=1e-6)
    assert {topic for topic, _, _ in found} == {"/run/commands", "/run/positions"}
