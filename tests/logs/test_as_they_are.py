"""Logs as instruments write them: rates, dates, registers, preambles, bad rows, sampled commands, JSON lines."""

import json
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.logs import read_logs, resample
from tests.logs.log_files import GOOD_MAP, HEADER, refused, rows, write

SIGNED = {"sign_magnitude": 10, "scale": 0.001}


def lines(table: np.ndarray) -> list[str]:
    return [",".join(map(repr, map(float, row))) for row in table]


def test_a_rate_stands_in_for_times(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows()[:, 1:], HEADER.removeprefix("time,"))
    (log,) = read_logs(tmp_path, arm, {"rate": 100})
    np.testing.assert_allclose(log.time, rows()[:, 0], atol=1e-12)
    np.testing.assert_allclose(log.qpos, rows()[:, 3:], atol=1e-11)  # a map that names no channel keeps their names
    (log,) = read_logs(tmp_path, arm, {**GOOD_MAP, "ctrl": {"m_shoulder": 0, "m_elbow": 1}, "rate": 100})
    assert log.period == pytest.approx(0.01)
    for rate in (0, -5, "fast", True):
        refused(tmp_path, arm, f"rate = {rate!r}", "above 0", map={"rate": rate})
    refused(tmp_path, arm, "time and rate", map={"rate": 100, "time": "t"})
    refused(tmp_path, arm, "missing column(s) time")


@pytest.mark.parametrize(
    "text", ["2026-03-01T10:15:{:06.3f}Z", "2026-03-01 10:15:{:06.3f}", "20260301T1015{:06.3f}+02:00"]
)
def test_dates_are_times(tmp_path: Path, arm: mujoco.MjModel, text: str) -> None:
    table = [
        f"{text.format(30 + row[0])},{line.partition(',')[2]}" for row, line in zip(rows(), lines(rows()), strict=True)
    ]
    path = tmp_path / "run.csv"
    path.write_text("\n".join([HEADER, *table]))
    (log,) = read_logs(tmp_path, arm)
    np.testing.assert_allclose(log.time, rows()[:, 0], atol=1e-9)
    path.write_text("\n".join([HEADER.replace("time", "stamp"), *table]))
    (log,) = read_logs(tmp_path, arm, {"time": "stamp"})
    np.testing.assert_allclose(log.time, rows()[:, 0], atol=1e-9)
    path.write_text("\n".join([HEADER, *table[:20], "yesterday,0,0,0,0", *table[20:]]))
    refused(tmp_path, arm, "run.csv", "'time'", "line 22", "'yesterday'", "ISO 8601")


def test_dates_with_and_without_zone_are_two_kinds(tmp_path: Path, arm: mujoco.MjModel) -> None:
    zone = ["Z"] * 39 + [""]
    stamps = [f"2026-03-01T10:15:{30 + row[0]:06.3f}{z}" for row, z in zip(rows(), zone, strict=True)]
    table = [f"{stamp},0,0,0,{i}e-3" for i, stamp in enumerate(stamps)]
    (tmp_path / "run.csv").write_text("\n".join([HEADER, *table]))
    refused(tmp_path, arm, "line 41", "without a time zone")


def test_registers_of_sign_and_magnitude(tmp_path: Path, arm: mujoco.MjModel) -> None:
    load = (900 * np.sin(19 * rows()[:, 0])).round()
    register = np.where(load < 0, 1024 - load, load)
    write(tmp_path, np.c_[rows(), register], HEADER + ",load")
    whole = {**GOOD_MAP, "streams": {"effort:m_elbow": {"column": "load", **SIGNED}}}
    (log,) = read_logs(tmp_path, arm, whole)
    assert load.min() < -800
    np.testing.assert_allclose(log.streams["effort:m_elbow"], 0.001 * load, atol=1e-12)
    register[7] = 2048
    write(tmp_path, np.c_[rows(), register], HEADER + ",load")
    refused(tmp_path, arm, "run.csv", "'load'", "line 9", "2048", "bit 10", "0 to 2047", map=whole)
    for entry, words in (
        ({"column": 1, "sign_magnitude": 0}, ("sign_magnitude = 0", "1 to 62")),
        ({"column": 1, "sign_magnitude": 10, "signed": 16}, ("signed and sign_magnitude", "one of them")),
    ):
        refused(tmp_path, arm, "ctrl.m_elbow", *words, map={"ctrl": {"m_elbow": entry}})


def test_lines_before_the_header_are_skipped(tmp_path: Path, arm: mujoco.MjModel) -> None:
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["Recorder 3, serial 17", "", HEADER, *lines(rows())]))
    (log,) = read_logs(tmp_path, arm, {"skip_rows": 2})
    np.testing.assert_allclose(log.qpos, rows()[:, 3:])
    path.write_text(path.read_text() + "\n1,2,x,4,5")
    refused(tmp_path, arm, "line 44", "'x' is not a number", map={"skip_rows": 2})
    for count in (-1, 1.5, "two"):
        refused(tmp_path, arm, f"skip_rows = {count!r}", "lines from 0", map={"skip_rows": count})


def broken(folder: Path) -> None:
    """43 lines of data: a half line, a command and an effort that are no numbers, and a time that comes twice."""
    table = [f"{line},{0.1 * i}" for i, line in enumerate(lines(rows()))]
    table[4] = table[4].replace(table[4].split(",")[2], "ERR")
    table[9] = table[9].rpartition(",")[0] + ",overflow"
    table[12] = table[12].rpartition(",")[0] + ","  # not sampled: nobody's fault
    table = [*table[:20], "0.2,1.", table[19], *table[20:]]
    (folder / "run.csv").write_text("\n".join([HEADER + ",effort:m_elbow", *table]))


def test_bad_rows_are_refused_unless_the_map_says_what_to_do(tmp_path: Path, arm: mujoco.MjModel) -> None:
    broken(tmp_path)
    refused(tmp_path, arm, "run.csv", "line 22 has 2 fields", map={"bad_rows": "error"})
    refused(tmp_path, arm, "bad_rows = 'skip'", "error, drop", map={"bad_rows": "skip"})
    with pytest.warns(
        UserWarning, match=r"4 of 42 rows \(9.5 %\) left out; first line 6: column 'ctrl:m_elbow' holds 'ERR'"
    ):
        (log,) = read_logs(tmp_path, arm, {"bad_rows": "drop"})
    kept = np.delete(np.arange(40), [4, 9])
    np.testing.assert_allclose(log.qpos, rows()[kept, 3:])
    assert np.isnan(log.streams["effort:m_elbow"]).sum() == 1


def test_a_row_may_be_kept_for_what_else_it_holds(tmp_path: Path, arm: mujoco.MjModel) -> None:
    broken(tmp_path)
    with pytest.warns(
        UserWarning, match=r"3 of 42 rows .* fields of 1 row\(s\) count as missing, first line 11.*'overflow'"
    ):
        (log,) = read_logs(tmp_path, arm, {"bad_rows": "nan"})
    np.testing.assert_allclose(log.time, rows()[np.delete(np.arange(40), [4]), 0])
    assert np.flatnonzero(np.isnan(log.streams["effort:m_elbow"])).tolist() == [8, 11]
    sound = tmp_path / "sound"
    sound.mkdir()
    write(sound, rows())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_logs(sound, arm, {"bad_rows": "drop"})


def test_lines_are_counted_as_in_the_file_after_rows_were_left_out(tmp_path: Path, arm: mujoco.MjModel) -> None:
    broken(tmp_path)
    text = (tmp_path / "run.csv").read_text().splitlines()
    text[35] = text[35].replace(text[35].split(",")[3], "50", 1)
    (tmp_path / "run.csv").write_text("\n".join(text))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refused(tmp_path, arm, "'qpos:shoulder'", "line 36", "rad in one step", map={"bad_rows": "drop"})


@pytest.mark.parametrize("by", ["map", "side"])
def test_linear_commands_have_their_mean_in_every_step(tmp_path: Path, arm: mujoco.MjModel, by: str) -> None:
    """The mean of a straight line over a step is its value in the middle, whatever the rows are."""
    table = rows(41)
    table[:, 1] = 4 * table[:, 0]
    write(tmp_path, np.delete(table, [3, 4, 17], axis=0))
    if by == "side":
        (tmp_path / "run.yaml").write_text("hold: linear\n")
    (log,) = read_logs(tmp_path, arm, {"hold": "linear"} if by == "map" else None)
    assert log.linear
    for dt in (0.004, 0.01, 0.03):
        even = resample(log, dt)
        inside = even.time + dt < 0.4
        np.testing.assert_allclose(even.ctrl[inside, 0], 4 * (even.time[inside] + dt / 2), atol=1e-9)
        assert not even.linear and resample(even, dt).ctrl[3, 0] == even.ctrl[3, 0]  # averaged once
    write(tmp_path, table)
    np.testing.assert_allclose(resample(read_logs(tmp_path, arm, {"hold": "linear"})[0], 0.01).ctrl[:-1, 0],
                               4 * (table[:-1, 0] + 0.005), atol=1e-9)  # fmt: skip
    refused(tmp_path, arm, "hold = 'cubic'", "linear", map={"hold": "cubic"})
    (tmp_path / "run.yaml").write_text("hold: 3\n")
    refused(tmp_path, arm, "run.csv", "hold = 3", "previous, linear")


def test_json_lines_hold_the_same_log(tmp_path: Path, arm: mujoco.MjModel) -> None:
    def sample(row: np.ndarray) -> dict:
        t, a, b, q, w = map(float, row)
        return {"time": t, "ctrl": {"m_shoulder": a, "m_elbow": b}, "qpos": {"shoulder": q, "elbow": w}, "on": True}

    path = tmp_path / "run.jsonl"
    path.write_text("\n".join(json.dumps(sample(row)) for row in rows()) + "\n\n")
    (log,) = read_logs(tmp_path, arm)
    np.testing.assert_array_equal(log.qpos, rows()[:, 3:])
    np.testing.assert_array_equal(log.ctrl, rows()[:, 1:3])
    assert log.streams["on"].tolist() == [1.0] * 40
    foreign = [json.dumps({"t": float(r[0]), "u": [float(r[1]), float(r[2])], "q": float(r[3])}) for r in rows()]
    path.write_text("\n".join(foreign))
    names = {"m_shoulder": "u[0]", "m_elbow": "u[1]"}
    log_map = {"time": "t", "ctrl": names, "qpos": {"shoulder": "q", "elbow": {"value": 0}}}
    (log,) = read_logs(tmp_path, arm, log_map)
    np.testing.assert_array_equal(log.ctrl, rows()[:, 1:3])
    path.write_text("\n".join([*foreign[:7], '{"t": 0.07, "u"', *foreign[7:]]))
    refused(tmp_path, arm, "run.jsonl", "line 8", "not JSON", "one object per line", map=log_map)
    with pytest.warns(UserWarning, match=r"1 of 41 rows .* first line 8: .*not JSON"):
        assert len(read_logs(tmp_path, arm, {**log_map, "bad_rows": "drop"})[0]) == 40
    for text, words in (("[1, 2]", ("line 1", "list in place of an object")), ("\n", ("no data rows",)),
                        ('{"q": {"a": 1}, "q:a": 2}', ("line 1", "two values of 'q:a'"))):  # fmt: skip
        path.write_text(text)
        refused(tmp_path, arm, "run.jsonl", *words, map=log_map)


def test_decimal_commas_in_texts_of_json_need_their_key(tmp_path: Path, arm: mujoco.MjModel) -> None:
    names = {"m_shoulder": "u[0]", "m_elbow": "u[1]"}
    log_map = {"time": "t", "ctrl": names, "qpos": {"shoulder": "q", "elbow": {"value": 0}}}
    lines = [{"t": r[0], "u": [r[1], r[2]], "q": str(r[3]).replace(".", ",")} for r in rows().tolist()]
    (tmp_path / "run.jsonl").write_text("\n".join(map(json.dumps, lines)))
    refused(tmp_path, arm, "run.jsonl", "`decimal`", map=log_map)
    (log,) = read_logs(tmp_path, arm, {**log_map, "decimal": ","})
    np.testing.assert_array_equal(np.c_[log.time, log.ctrl, log.qpos[:, 0]], rows()[:, :4])
