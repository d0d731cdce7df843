"""What tests of the importers share: the command, the log it makes, and messages of ROS."""

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.logs import Log, read_logs
from tests.logs.log_files import ARM

START = 1_700_000_000_000_000_000  # ns


def named(**content: Any) -> Any:
    return SimpleNamespace(**content)


def stamp(ns: int) -> Any:
    return named(stamp=named(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="")


def call(capsys: pytest.CaptureFixture, *argv: str | Path) -> str:
    code = import_logs.main([str(word) for word in argv])
    out = capsys.readouterr()
    assert code == 0, out.err
    return out.out


def error(capsys: pytest.CaptureFixture, *argv: str | Path) -> str:
    assert import_logs.main([str(word) for word in argv]) == 2
    return capsys.readouterr().err


def model_of(folder: Path) -> Path:
    (folder / "arm.xml").write_text(ARM)
    return folder / "arm.xml"


def read(folder: Path) -> Log:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (log,) = read_logs(folder, mujoco.MjModel.from_xml_string(ARM))
    return log
