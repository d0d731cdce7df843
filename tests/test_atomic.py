"""Files are written whole or not at all."""

import numpy as np
import pytest

from bayessim_mjx import atomic


class Killed(BaseException):
    """What stops a process in the middle of a write; no handler of errors catches it."""


@pytest.mark.parametrize("error", [OSError("disk full"), Killed()])
@pytest.mark.parametrize("mode", ["w", "wb"])
def test_a_failed_write_leaves_the_old_file_alone(tmp_path, error, mode):
    path = tmp_path / "found.json"
    path.write_text("old")
    with pytest.raises(type(error)), atomic.replacing(path, mode) as file:
        file.write("half" if mode == "w" else b"half")
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_put_in_place_leaves_the_old_one_alone(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError("no")

    path = tmp_path / "a.txt"
    atomic.write_text(path, "old")
    monkeypatch.setattr(atomic.os, "replace", refuse)
    with pytest.raises(PermissionError):
        atomic.write_text(path, "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_the_old_file_is_there_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.zeros(2))
    with atomic.replacing(path) as file:
        np.savez(file, x=np.ones(3))
        assert np.load(path)["x"].tolist() == [0, 0]
    assert np.load(path)["x"].tolist() == [1, 1, 1] and list(tmp_path.iterdir()) == [path]


def test_texts_and_bytes_are_written_as_they_are(tmp_path):
    path = tmp_path / "a"
    atomic.write_text(path, "1 µm\n")
    assert path.read_bytes() == "1 µm\n".encode()
    atomic.write_bytes(path, b"\0\1")
    assert path.read_bytes() == b"\0\1"
    atomic.write_json(path, {"a": [1, None]})
    assert path.read_text() == '{\n "a": [\n  1,\n  null\n ]\n}'
