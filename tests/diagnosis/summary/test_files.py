"""What a diagnosis reports while it runs reaches the caller, with a folder and without one."""

import dataclasses

import pytest

from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.summary.files import Files


def test_progress_and_the_first_lines_reach_the_caller_and_without_a_folder_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    heard = []
    files = Files(None, {}, lambda *given: heard.append(given), heard.append)
    files.progress("screening", 1, 2)
    files.early(["hinge: 3 % unexplained"])
    files.known(None, None)
    files.verdict(None)
    assert heard == [("screening", 1, 2), ["hinge: 3 % unexplained"]]
    assert files.search is None and list(tmp_path.iterdir()) == []


def test_nobody_has_to_listen(tmp_path):
    files = Files(tmp_path, {})
    files.progress("screening", 1, 2)
    files.early(["hinge: 3 % unexplained"])
    assert files.search.parent == tmp_path and list(tmp_path.iterdir()) == []


def test_a_request_stays_as_it_was_made():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Request().seed = 1
