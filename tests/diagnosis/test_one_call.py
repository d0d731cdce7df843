"""One call from Python: model and logs in, a Diagnosis out; stages that fail; both names of `bayessim_mjx.diagnose`."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import mujoco
import numpy as np
import pytest
import threadpoolctl

import bayessim_mjx
from bayessim_mjx import diagnosis
from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.findings import Findings, Observer, Where, carry_out
from bayessim_mjx.diagnosis.fitting.cutting import TooLittleData
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.residual.where import Located
from bayessim_mjx.diagnosis.selection.numbers import Budget
from bayessim_mjx.errors import UserError
from tests.diagnosis.pendulums import MODEL, nominal, recorded, saved
from tests.report import fake

FRICTION = 0.04
XML = MODEL % (0.002, "Euler", 0.02, 0.005, 0.0, 0.5)


def found() -> Findings:
    return Findings(SimpleNamespace(), SimpleNamespace(answer="a model"))


def broken(findings, say):
    raise ValueError("no map")


def test_an_optional_stage_that_fails_is_a_warning_and_any_other_an_error():
    start, said = found(), []

    class Says(Observer):
        def progress(self, text, done, total):
            said.append((text, done, total))

    after = carry_out([run.Stage("maps", broken, optional=True)], start, Budget(), Says())
    assert after.warnings == ("maps: not available (ValueError: no map)",) and said == [("maps", 0, 1)]
    assert start.warnings == () and after.model == "a model"
    with pytest.raises(ValueError, match="no map"):
        carry_out([run.Stage("maps", broken)], start, Budget(), Observer())


def test_findings_are_values():
    start, part = found(), Where(Located(), ())
    more = start.having(part)
    assert start.part(Where) is None and more.part(Where) is part and more.part(int) is None
    with pytest.raises(dataclasses.FrozenInstanceError):
        more.warnings = ("x",)
    with pytest.raises(TypeError):
        more.parts[int] = 1
    assert isinstance(start.predictions, MappingProxyType)


@pytest.mark.parametrize("minutes", ["0", "-2", "soon", "inf"])
def test_a_limit_of_time_is_a_number_of_minutes(minutes, capsys):
    assert bayessim_mjx.diagnose.main(["--minutes", minutes]) == 2
    assert f"'{minutes}': allowed: minutes, more than 0" in capsys.readouterr().err


BOTH = "assert callable(b.diagnose) and b.diagnose.main(['--headless']) == 2"
ORDERS = (
    "import bayessim_mjx as b",
    "import bayessim_mjx.diagnose, bayessim_mjx as b",
    "import bayessim_mjx as b; from bayessim_mjx import diagnose; assert diagnose is b.diagnose",
    "from bayessim_mjx.diagnose import main; import bayessim_mjx as b; assert b.diagnose.main is main",
)


@pytest.mark.parametrize("code", ORDERS)
def test_module_and_function_are_there_in_any_order_of_imports(code):
    told = subprocess.run([sys.executable, "-c", f"{code}; {BOTH}"], capture_output=True, text=True, check=False)
    assert told.returncode == 0 and "give one of --task NAME and --model FILE" in told.stderr, told.stderr


def test_a_path_is_a_model_and_a_plain_name_a_task():
    with pytest.raises(UserError, match=r"x\.xml: no such file"):
        bayessim_mjx.diagnose("x.xml", "logs")
    with pytest.raises(UserError, match="'x' is unknown.*Pendulum"):
        bayessim_mjx.diagnose("x", "logs")


def test_a_robot_of_a_task_has_its_name_and_model():
    robot = bayessim_mjx.robot("pendulum")
    assert robot.name == "Pendulum" and robot.mj_model.nu == 1
    with pytest.raises(UserError, match="'x' is unknown.*Pendulum"):
        bayessim_mjx.robot("x")


@pytest.mark.parametrize("more", [{}, {"verdict_only": True}])
def test_out_writes_what_the_command_writes(more, tmp_path, monkeypatch, capsys):
    """The computation is replaced by a result, which both write."""
    nominal(tmp_path)
    calls = []

    def diagnose(robot, logs, **options):
        calls.append((robot.name, options))
        fake.full().save(options["out"])
        return fake.full()

    monkeypatch.setattr(run, "diagnose", diagnose)
    model, flags = str(tmp_path / "pendulum.xml"), [f"--{flag}" for flag in more]
    words = ["--model", model, "--data", "logs", "--out", str(tmp_path / "a"), "--accuracy", "5%", "--headless", *flags]
    assert bayessim_mjx.diagnose.main(words) == 0
    assert "Missing effects found (effects), after" in capsys.readouterr().out
    found = bayessim_mjx.diagnose(model, ["logs"], out=tmp_path / "b", accuracy=["5%"], **more)
    assert capsys.readouterr().err == "" and found.verdict == "effects"
    kinds = [{re.sub(r"[0-9.]+", "#", f.name) for f in (tmp_path / folder).rglob("*")} for folder in "ab"]
    assert kinds[0] == kinds[1] and ("report#html" in kinds[0]) is not bool(more)
    (name, asked), (same, given) = calls
    both = {*asked} & {*given} - {"out", "progress"}
    assert name == same and {"accuracy", *more} <= both and {k: asked[k] for k in both} == {k: given[k] for k in both}


def test_verdicts_have_words_that_the_report_has_too():
    from bayessim_mjx.diagnosis.phrases import advice

    assert [v.words for v in diagnosis.Verdict] == [advice.VERDICTS[v].badge for v in diagnosis.Verdict]
    page = (Path(__file__).parents[2] / "docs" / "diagnosis.md").read_text().lower()
    assert [v.words for v in diagnosis.Verdict if v.words.lower() not in page] == []
    assert diagnosis.Verdict("effects") == "effects" == f"{fake.full().verdict}"
    assert json.loads(json.dumps(fake.full().to_dict()))["verdict"] == "effects"


def test_a_robot_comes_from_a_file_a_specification_a_model_or_itself(tmp_path):
    own = nominal(tmp_path)
    spec = mujoco.MjSpec.from_string(XML)
    spec.modelname = "swing"
    sources = (tmp_path / "pendulum.xml", str(tmp_path / "pendulum.xml"), spec, spec.compile())
    robots = [diagnosis.robot(source) for source in sources]
    assert [r.name for r in robots] == ["pendulum", "pendulum", "swing", "swing"]
    assert all(r.space.names == own.space.names for r in robots)
    assert diagnosis.robot(own).space.names == own.space.names and robots[2].spec is not None and robots[3].spec is None
    with pytest.raises(UserError, match="no actuator"):
        bare = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
        diagnosis.robot(mujoco.MjModel.from_xml_string(bare))


# not in CI: tests/test_docs.py::test_the_how_to_of_an_own_robot_finds_its_hidden_friction makes the same call
@pytest.mark.slow
def test_one_call_finds_the_friction_and_gives_a_corrected_simulator(tmp_path):
    nominal(tmp_path)
    (tmp_path / "logs").mkdir()
    logs = recorded(friction=FRICTION, count=4, seconds=3.0)
    saved(tmp_path / "logs", logs)
    told = []
    result = bayessim_mjx.diagnose(
        str(tmp_path / "pendulum.xml"), tmp_path / "logs", effects=["coulomb_friction"], tolerance="5deg",
        out=tmp_path / "found", progress=lambda text, done, total: told.append(text),
    )  # fmt: skip
    assert result.verdict == "effects" and told[0] == "looking at the logs"
    assert any("next experiment" in text for text in told)  # stages that run side by side are one line
    (effect,) = result.effects
    assert effect.parameters["level"].mean == pytest.approx(FRICTION, rel=0.05)
    physics = diagnosis.robot(tmp_path / "pendulum.xml").physics(0.02)
    corrected = result.apply(physics)
    assert "coulomb_friction" in {e.name for e in corrected.effects}
    level = corrected.space.nominal[corrected.space.index("hinge.coulomb_friction.level")]
    assert level == pytest.approx(FRICTION, rel=0.05)
    prior = result.prior(physics)
    assert prior.space.names == corrected.space.names and np.isfinite(prior.mean()).all()
    assert diagnosis.load(tmp_path / "found").to_dict() == result.to_dict()
    assert json.loads((tmp_path / "found" / "diagnosis.json").read_text())["about"]["logs"] == 4
    written = {p.name for p in (tmp_path / "found").iterdir()}
    assert {"diagnosis.json", "details.json", "effects.yaml", "model_with_effects.xml"} <= written
    assert "preliminary.json" not in written and "report.html" in written


@pytest.mark.slow
def test_logs_in_memory_and_a_compiled_model_leave_no_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = mujoco.MjModel.from_xml_string(XML)
    monkeypatch.setattr(run, "STAGES", tuple(stage for stage in run.STAGES if not stage.optional))
    result = diagnosis.diagnose(model, recorded(count=4, seconds=3.0), effects=["coulomb_friction"])
    assert result.verdict == "no_gap" and list(tmp_path.iterdir()) == [] and result.about["data"][0] == "log0"
    assert result.save(tmp_path / "kept").is_file()
    short = diagnosis.diagnose(model, recorded(count=1, seconds=2.0)[0], effects=["coulomb_friction"])
    assert short.verdict == "insufficient_data" and short.about["logs"] == 1


def test_blas_has_one_thread_while_a_diagnosis_runs(monkeypatch):
    """Its threads wait for each other where other processes have the cores: six times the seconds were measured."""
    seen = []

    def prepare(*args, **named):
        seen.extend(pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas")
        raise TooLittleData("enough seen")

    monkeypatch.setattr(run, "prepare", prepare)
    with threadpoolctl.threadpool_limits(2, user_api="blas"), pytest.raises(TooLittleData):
        run.investigate(None, [])
    assert seen and set(seen) == {1}


@pytest.mark.parametrize("left_out", [{"quick": True}, {"verdict_only": True}, {}])
def test_the_verdict_alone_has_no_optional_stages(monkeypatch, left_out):
    setup = SimpleNamespace(said=(), fitter=None, candidates=None, settings=None)
    monkeypatch.setattr(run, "prepare", lambda *a, **k: setup)
    monkeypatch.setattr(run.selecting, "select", lambda *a: SimpleNamespace(answer="a model"))
    ran = []

    def stage(name, optional):
        return run.Stage(name, lambda findings, say: ran.append(name) or findings, optional=optional)

    stages = [stage("how far", False), stage("maps", True)]
    run.investigate(None, [], Request(**left_out), stages=stages)
    assert ran == (["how far"] if left_out else ["how far", "maps"])


def test_the_verdict_alone_writes_no_page_and_leaves_none_of_an_earlier_answer(tmp_path, monkeypatch, capsys):
    asked = {}
    monkeypatch.setattr(run, "diagnose", lambda *a, **k: asked.update(k) or fake.full())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").write_text("of an earlier answer")
    nominal(tmp_path)
    words = ["--model", str(tmp_path / "pendulum.xml"), "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert bayessim_mjx.diagnose.main([*words, "--headless", "--verdict_only"]) == 0
    assert asked["verdict_only"] and list((tmp_path / "out").iterdir()) == []
    told = capsys.readouterr().out
    assert "report.html" not in told and told.rstrip().endswith("diagnosis.json")
