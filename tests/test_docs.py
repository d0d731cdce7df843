"""README, docs and benchmarks name only what exists (links, anchors, commands, flags, settings, files); code runs."""

import contextlib
import dataclasses
import functools
import importlib.util
import io
import json
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import bayessim_mjx
from bayessim_mjx import diagnosis, effects, main, registry, rl
from bayessim_mjx.cli import ancestors
from bayessim_mjx.config import settings
from bayessim_mjx.tasks.locomotion import Locomotion

ROOT = Path(__file__).parents[1]
COMMANDS = ("main", "train", "play", "calibrate", "diagnose", "blind", "gap_loop", "logs", "policy", "implementations")
FORMATS = (
    "check",
    "show",
    "from-mcap",
    "from-rosbag",
    "from-lerobot",
    "from-hdf5",
    "from-pace",
)  # of `logs`, each with flags of its own
FOLDERS = ("docs", "benchmarks")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(p for f in FOLDERS for p in sorted((ROOT / f).rglob("*.md")))]
PYTHON = {"env.reset", "env.step", "env.dt", "env.mj_model", "env.space", "ppo.train"}  # in Python, not settings
COMMAND = re.compile(
    r"(?:python -m bayessim_mjx\.(\w+)"
    r"|bayessim-mjx ((?:main|train|play|calibrate|diagnose|blind|gap-loop|logs|policy|implementations)?)"
    r"|python ((?:benchmarks|examples|docs)/[\w/]+\.py))([^`\n#&]*)"
)
PROSE = re.compile(r"`(main|train|play|calibrate|diagnose|blind|gap_loop|implementations) (--[^`\n]*)`")

CODE = re.compile(r"```python\n(.*?)```", re.DOTALL)
API = re.compile(r"^::: .*$", re.MULTILINE)  # a name in Python, whose docstring the site shows
FILE = re.compile(r'"""(\w+\.py): ')  # a block that begins so is that file
TINY = [
    "env.numEnvs=8", "ppo.num_envs=8", "ppo.num_steps=16", "ppo.max_iterations=2", "bayessim.trainTrajs=200",
    "bayessim.realEvals=4", "bayessim.checkTrajs=40", "bayessim.refine=off",
]  # fmt: skip


@functools.cache
def flags_of(command: str) -> set[str]:
    """Flags of a command of the library, as its --help has them, or of a script, as its source has them."""
    if command.endswith(".py"):
        return set(re.findall(r'"(--[a-z][\w-]*)"', (ROOT / command).read_text())) | {"--help"}
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        for first in {"logs": FORMATS, "policy": ("check",)}.get(command, ("",)):
            main.main([command, *filter(None, [first]), "--help"])
    return set(re.findall(r"--[a-z][a-z_-]*", text.getvalue()))


def commands(text: str) -> list[tuple[str, str]]:
    """(command or script, its arguments) of all that a page tells to type."""
    found = [
        (module or script or named.replace("-", "_") or "main", words)
        for module, named, script, words in COMMAND.findall(text)
    ]
    return found + PROSE.findall(text)


def keys() -> set[str]:
    """`section.key` of every setting; sections within sections by their prefix."""
    found = set()
    for thing in vars(settings).values():
        if dataclasses.is_dataclass(thing) and getattr(thing, "SECTION", ""):
            found |= {f"{thing.SECTION}.{field.name}" for field in dataclasses.fields(thing)}
    return found | {"env.maxEpisodeLength"}  # BayesSimIG's other name of env.episodeLength


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    titles = [re.sub(r"[`*]", "", title).strip().lower() for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in titles}


def broken(page: Path) -> list[str]:
    """Links of a page to files or anchors that are not there."""
    found = []
    for link in map("".join, re.findall(r'\]\(([^)\s]+)|src="([^"]+)"', page.read_text())):
        if link.startswith("http"):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            found.append(link)
    return found


WORDS = {"README.md": 700, "CHANGELOG.md": 400, "docs/**/*.md": 18_000}  # marks of tables count as words


@pytest.mark.parametrize("pages", WORDS)
def test_pages_keep_to_their_words(pages):
    files = sorted(ROOT.glob(pages))
    assert files and sum(len(f.read_text(encoding="utf-8").split()) for f in files) <= WORDS[pages]


def by_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def code_of(page: Path) -> list[str]:
    return CODE.findall(page.read_text())


def run(blocks: list[str], name: str, monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Run a page's blocks one after the other, as one module, in the working directory."""
    module = types.ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    for block in blocks:
        if named := FILE.match(block):
            Path(named[1]).write_text(block)
        exec(compile(block, f"{name}.md", "exec"), module.__dict__)
    return module


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_links_and_anchors_resolve(page):
    assert broken(page) == []
    files = re.findall(r"`((?:examples|benchmarks|tests|docs|cfg|tasks)/[\w/.]+\.(?:py|md|yaml))`", page.read_text())
    assert [name for name in files if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_commands_and_their_flags_exist(page):
    for command, words in commands(page.read_text()):
        assert command in COMMANDS or (ROOT / command).is_file(), command
        assert set(re.findall(r"(?<![\w-])--[a-z][a-z_-]*", words.split(" -- ")[0])) <= flags_of(command), (
            command,
            words,
        )


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_settings_and_flags_in_prose_exist(page):
    text, known = API.sub("", CODE.sub("", page.read_text())), keys()
    named = set(re.findall(r"\b(?<!/)((?:bayessim|ppo|monitor|env|real)\.(?!py\b|json\b)[a-zA-Z_]+)\b", text)) - PYTHON
    assert {name for name in named if name not in known} == set()
    somewhere = set().union(*(flags_of(c) for c in COMMANDS), *(flags_of(c) for c, _ in commands(text)))
    somewhere |= {*ancestors.SAME, *ancestors.INSTEAD, "--real-time"}
    assert set(re.findall(r"`(--[a-z][a-z_-]*)", text)) <= somewhere | scripts_flags(page)


def scripts_flags(page: Path) -> set[str]:
    """A page among the benchmarks may name flags of their scripts without the script beside them."""
    scripts = (ROOT / "benchmarks").glob("*/*.py") if page.parent.name == "benchmarks" else ()
    return set().union(*(flags_of(str(path.relative_to(ROOT))) for path in scripts))


def test_all_tasks_and_rooms_are_told_of():
    tasks, rooms = (ROOT / "docs" / "tasks.md").read_text(), (ROOT / "docs" / "architecture.md").read_text()
    assert [name for name in registry.names() if f"| **{name}**: " not in tasks] == []
    packages = [p.parent for p in (ROOT / "bayessim_mjx").rglob("__init__.py")]
    own = {p.name for p in packages if p.parent in (ROOT / "bayessim_mjx", ROOT / "bayessim_mjx" / "diagnosis")}
    assert {name for name in own - {"tasks"} if f"{name}/" not in rooms} == set()


def test_every_page_is_in_the_menu_of_the_site_and_every_public_name_in_its_api():
    menu = (ROOT / "mkdocs.yml").read_text()
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in PAGES if page.is_relative_to(ROOT / "docs")]
    assert [name for name in pages if f" {name}\n" not in menu] == []
    shown = set(re.findall(r"^::: .*\.(\w+)$", "".join(p.read_text() for p in (ROOT / "docs/api").glob("*.md")), re.M))
    assert set(bayessim_mjx.__all__) <= shown


def test_the_site_makes_tables_of_all_settings_and_effects():
    named = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    hooks = importlib.util.module_from_spec(named)
    named.loader.exec_module(hooks)
    pages = "".join(page.read_text() for page in PAGES)
    for thing in vars(settings).values():
        section = dataclasses.is_dataclass(thing) and getattr(thing, "SECTION", "")
        if section:
            keys = [
                field.name
                for field in dataclasses.fields(thing)
                if not field.metadata["doc"].startswith("settings of this")
            ]
            assert re.findall(r"^\| `(\w+)` \|", hooks.table(section), re.M) == keys
            assert f"<!-- table: {section} -->\n" in pages
    assert set(re.findall(r"^\| `(\w+)` \|", hooks.table("effects"), re.M)) == set(effects.names())
    parts = re.findall(r"^\| (observ|reward)\w+ \| `(\w+)` \| \w", hooks.table("locomotion"), re.M)
    own = [re.match("(observ|reward)e?_(.*)", name) for name in dir(Locomotion)]
    assert set(parts) == {found.groups() for found in own if found} and len(parts) > 20


@functools.cache
def spoken() -> str:
    """The source of the package, with texts that continue on the next line as one."""
    files = sorted((ROOT / "bayessim_mjx").rglob("*.py"))
    return re.sub(r"[\"']\s*\n\s*f?[\"']", "", "".join(f.read_text(encoding="utf-8") for f in files))


def test_sentences_of_the_console_are_those_of_the_package():
    rows = re.findall(r"^\| `([^`|]+)`", (ROOT / "docs" / "troubleshooting.md").read_text(), re.MULTILINE)
    parts = [part.strip() for row in rows for part in re.split(r"…|[A-Z]{4,}|\d[\d.]*", row)]
    long = [part for part in parts if len(part) > 12]
    assert len(long) > 20 and [part for part in long if part not in spoken()] == []


def test_the_first_look_of_the_docs_is_that_of_the_package():
    """The lines before any simulation are copied from a run: their words are still those of the package."""
    page = (ROOT / "docs/diagnosis.md").read_text()
    block = page.partition("Before any simulation (")[2].partition("```")[0]
    parts = re.split(r"command -> motion: |elbow|Coulomb friction|level|\n|\d[\d.]*", block)
    long = [text for part in parts if len(text := part.strip(" %;\n+-")) > 10]
    assert len(long) > 4 and [text for text in long if text not in spoken()] == []


def test_a_film_of_every_task_says_what_it_shows():
    films, page = ROOT / "docs" / "pictures" / "tasks", (ROOT / "docs" / "tasks.md").read_text()
    shown = json.loads((films / "films.json").read_text())
    assert set(shown) == set(registry.names())
    assert [
        task for task, words in shown.items() if f"**{task}**: " not in page or f"Shown: {words}." not in page
    ] == []
    assert [path.name for path in films.glob("*.gif") if path.stat().st_size > 200_000] == []


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_code_is_python(page):
    for block in code_of(page):
        compile(block, page.name, "exec")


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("name", ["own_effect", "own_task"])
def test_code_of_a_how_to_runs(name, tmp_path, monkeypatch):
    """Where it trains, shortly: other tests are about learning."""
    monkeypatch.chdir(tmp_path)
    train = rl.train
    monkeypatch.setattr(
        rl, "train", lambda env, ppo, *more: train(env, dataclasses.replace(ppo, max_iterations=3), *more)
    )
    run(code_of(ROOT / "docs" / f"{name}.md"), name, monkeypatch)


@pytest.mark.slow
@pytest.mark.ci
def test_the_how_to_of_an_own_robot_finds_its_hidden_friction(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = run(code_of(ROOT / "docs" / "own_robot.md"), "own_robot", monkeypatch)
    [effect] = page.diagnosis.effects
    assert (effect.name, effect.where) == ("coulomb_friction", "elbow")
    level = effect.parameters["level"].mean
    assert 0.10 < level < 0.14  # 0.12 N m; masses are free within 20 %
    corrected = page.corrected.space
    assert corrected.nominal[corrected.index("elbow.coulomb_friction.level")] == pytest.approx(level, rel=1e-5)
    assert page.domain.space.names == corrected.names and np.isfinite(page.domain.mean()).all()
    assert diagnosis.load(tmp_path / "found").to_dict() == page.diagnosis.to_dict()
    written = {path.name for path in (tmp_path / "found").iterdir()}
    assert {"diagnosis.json", "details.json", "effects.yaml", "model_with_effects.xml"} <= written
    assert "preliminary.json" not in written
    arm = page.Arm()  # the task of the same model, with what was found
    assert arm.mj_model.nu == 1 and arm.physics.space.names == ()


@pytest.mark.slow
def test_the_loop_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    import bayessim_mjx as bm

    load = bm.load
    monkeypatch.setattr(bm, "load", lambda task, overrides: load(task, overrides=[*overrides, *TINY]))
    page = run(code_of(ROOT / "README.md")[:1], "readme", monkeypatch)
    assert len(page.rounds) == 2 and page.posterior.mean().shape == (2,)


def test_a_missing_file_an_absent_anchor_and_an_unknown_flag_are_noticed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A `b` c?\n[x](#a-b-c) [y](#not) [z](none.md) `train --tasks Ant`\npython -m bayessim_mjx.main --hidden 3\n"
        "bayessim-mjx gap-loop --real logs\n"
    )
    assert broken(page) == ["#not", "none.md"]
    assert commands(page.read_text()) == [
        ("main", " --hidden 3"),
        ("gap_loop", " --real logs"),
        ("train", "--tasks Ant"),
    ]
    assert "--tasks" not in flags_of("train") and "--task" in flags_of("train")


@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/first_run.md"])
def test_pages_promise_of_the_first_command_what_the_clock_measured(page):
    table = json.loads((ROOT / "benchmarks" / "records" / "clock.json").read_text())["table"]
    seconds = next(float(row[1]) for row in table if row[0] == "main Pendulum, cold, cpu")
    assert f"{seconds / 60:.0f} CPU minutes" in (ROOT / page).read_text()
