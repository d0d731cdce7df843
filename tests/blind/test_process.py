"""An entry cannot read the truths, what it costs is told, and one that hangs is ended."""

import sys
from pathlib import Path

import pytest

from bayessim_mjx.blind import process

apart = pytest.mark.skipif(not process.apart(), reason="this system has no Landlock")
WAYS = {
    "read": "print(open(secret).read())",
    "copy": "import shutil; shutil.copy(secret, 'copy'); print(open('copy').read())",
    "link": "import os; os.link(secret, 'link'); print(open('link').read())",
    "move": "import os; os.rename(secret, 'moved'); print(open('moved').read())",
    "symlink": "import os; os.symlink(secret, 'there'); print(open('there').read())",
    "child": "import subprocess; subprocess.run(['cat', secret], check=True)",
}


@pytest.fixture
def run(tmp_path):
    """Runs Python code in a folder of its own beside a sealed truth; (how it ended, what it printed)."""
    for name in ("work", "check/sealed"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "check" / "sealed" / "0.json").write_text("backlash")

    def run(code: str, hidden: bool = True, timeout: float = 60.0) -> tuple[process.Ended, str]:
        sealed, out = tmp_path / "check" / "sealed", tmp_path / "said.txt"
        words = [sys.executable, "-c", f"secret = {str(sealed / '0.json')!r}\n{code}"]
        with out.open("w") as text:
            ended = process.run(words, tmp_path / "work", text, timeout, sealed if hidden else None)
        return ended, out.read_text()

    return run


@apart
@pytest.mark.parametrize("way", WAYS)
def test_a_sealed_truth_cannot_be_read(run, way):
    ended, said = run(WAYS[way])
    assert ended.code != 0 and not said.startswith("backlash")
    if way == "read":
        assert "PermissionError" in said
        assert run(WAYS[way], hidden=False)[1] == "backlash\n"  # what keeps it is the sandbox, not the path


@apart
def test_everything_else_works_as_without(run, tmp_path):
    (tmp_path / "check" / "model.xml").write_text("<mujoco/>")
    code = f"""
import json, os, tempfile
assert open({str(tmp_path / "check" / "model.xml")!r}).read() == '<mujoco/>'
with tempfile.TemporaryDirectory() as folder:
    open(folder + '/a', 'w').write('1')
    os.mkdir('out'); os.replace(folder + '/a', 'out/a')
print(open('out/a').read())
"""
    ended, said = run(code)
    assert (ended.code, said) == (0, "1\n")


def test_what_it_costs_is_told_with_what_its_children_cost(run):
    burn = "import time\nwhile time.process_time() < 0.6: pass"
    ended, _ = run(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {burn!r}])")
    assert ended.code == 0 and 0.6 < ended.cpu < ended.seconds + 1.0
    assert run("import sys; sys.exit(3)")[0].code == 3


def test_one_that_hangs_is_ended(run):
    ended, _ = run("import time; time.sleep(60)", timeout=1.0)
    assert ended.code == process.LATE and ended.seconds < 30


def test_no_such_program(tmp_path):
    with (tmp_path / "out.txt").open("w") as text, pytest.raises(FileNotFoundError):
        process.run(["no-such-program"], tmp_path, text, 1.0)


def test_what_lies_beside_a_folder_and_nothing_above_it(tmp_path):
    from bayessim_mjx.blind.confine import beside

    for name in ("a/sealed", "a/cases", "b"):
        (tmp_path / name).mkdir(parents=True)
    found = beside(tmp_path / "a" / "sealed")
    assert {tmp_path / "a" / "cases", tmp_path / "b"} <= set(found)
    assert not {tmp_path / "a", tmp_path / "a" / "sealed", *Path(tmp_path).parents} & set(found)
