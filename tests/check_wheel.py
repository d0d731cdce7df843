"""Run by CI with the Python of an environment that holds only the wheel, from a folder outside the checkout."""

import importlib.metadata
import importlib.util
import pathlib
import re
import sys

files = importlib.metadata.files("bayessim-mjx") or []
tops = {pathlib.PurePath(f).parts[0] for f in files} - {".."}
assert all(t == "bayessim_mjx" or t.startswith("bayessim_mjx-") for t in tops), f"the wheel installs {sorted(tops)}"
for name in ("tasks", "cfg"):
    assert importlib.util.find_spec(name) is None, f"a package named plainly {name!r} is importable"

import bayessim_mjx.tasks.pendulum  # noqa: E402

assert "site-packages" in bayessim_mjx.tasks.pendulum.__file__, bayessim_mjx.tasks.pendulum.__file__
assert "tasks" not in sys.modules
readme = importlib.metadata.metadata("bayessim-mjx").get_payload()
relative = re.findall(r'\]\((?!https?://|#)[^)]+\)|src="(?!https?://)[^"]+"', readme)
assert "bayessim_mjx" in readme and not relative, f"PyPI cannot follow {relative}"

from bayessim_mjx.rl import pretrained  # noqa: E402

assert [pretrained.pretrained(name) for name in pretrained.names()], "the wheel lacks the policies"

import os  # noqa: E402
import tempfile  # noqa: E402

import numpy as np  # noqa: E402

from bayessim_mjx import programs  # noqa: E402

with tempfile.TemporaryDirectory() as cache:  # a diagnosis keeps its programs, so what writes them has to be there
    os.environ["BAYESSIM_MJX_CACHE"] = cache
    programs.Kept(lambda x: 2 * x, "a product")(np.ones(3, np.float32))
    assert list(pathlib.Path(cache, programs.FOLDER).iterdir()), "no program was kept"
print("wheel: only bayessim_mjx is installed, tasks inside it")
