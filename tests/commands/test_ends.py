"""How commands end whose output nobody reads to its end."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
def test_a_closed_pipe_ends_quietly_and_the_work_is_done(tmp_path: Path) -> None:
    out = tmp_path / "done.txt"
    code = (
        "import sys; from pathlib import Path; from rich.console import Console; from bayessim_mjx.cli import ends\n"
        "def run(argv):\n"
        "    for k in range(20000): print(k); Console().print('line', k) if k % 1000 == 0 else None\n"
        f"    Path({str(out)!r}).write_text('done'); return 0\n"
        "sys.exit(ends.command(run)())"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141 and out.read_text() == "done"
