"""TensorBoard's files read back hold the numbers; the terminal's lines hold the words."""

import dataclasses
import io

import pytest

from bayessim_mjx import report
from bayessim_mjx.diagnosis.phrases.advice import VERDICTS as WORDS
from bayessim_mjx.diagnosis.result import VERDICTS
from bayessim_mjx.monitor.writer import event_files, records
from tests.report import fake


def _written(folder):
    values = [v for path in event_files(folder) for _, e in records(path) for v in e.summary.value]
    return {v.tag: v for v in values}


def test_tensorboard_holds_stages_closures_and_pictures(tmp_path):
    report.tensorboard(fake.full(), tmp_path)
    tags = _written(tmp_path)
    assert tags["Gap/nominal"].simple_value == pytest.approx(21.4)
    assert tags["Gap_whole_log/with_effects"].simple_value == pytest.approx(12.3)
    assert tags["Closed/coulomb_friction_elbow"].simple_value == pytest.approx(0.68)
    for tag in ("waterfall", "candidates", "overlays"):
        image = tags[f"Diagnosis/{tag}"].image
        assert image.encoded_image_string.startswith(b"\x89PNG") and image.width > 500


def test_tensorboard_without_numbers_has_the_verdict_only(tmp_path):
    report.tensorboard(fake.bare("insufficient_data"), tmp_path)
    assert set(_written(tmp_path)) == {"Gap/noise_floor", "Diagnosis/verdict/text_summary"}


def test_console_says_what_was_found_in_plain_lines(tmp_path):
    path = report.write(fake.full(), tmp_path)
    file = io.StringIO()
    report.console(fake.full(), tmp_path, file=file)
    text = file.getvalue()
    assert not set(text) & {"\x1b", "\r", "\b"}
    level = "0.0312 ± 0.0021 N m"
    for words in ("Missing effects found", "Coulomb friction at elbow", level, "68 %", str(path)):
        assert words in text
    assert "91 %; Stribeck friction · elbow 9.0 %" in text and "probability" not in text
    assert all(f"warning: {w}" in text for w in fake.full().warnings)
    assert "all 11 candidates: diagnosis.json" in text


def test_without_a_gap_no_candidate_is_ranked_on_the_terminal():
    """`Cogging closes 45 %` stood below `No gap above the noise`."""
    file = io.StringIO()
    report.console(dataclasses.replace(fake.full(), verdict="no_gap", effects=[]), file=file)
    assert "No gap" in file.getvalue() and "held-out score" not in file.getvalue()


def test_what_was_not_fitted_is_listed_with_the_reason(tmp_path):
    labels = [f"payload@link{i}" for i in range(3)] + [f"law_{i}@link0" for i in range(9)]
    found = dataclasses.replace(fake.full(), not_fitted={"no time left": labels, "no gain at first order": ["x@y"]})
    file = io.StringIO()
    report.console(found, file=file)
    text = " ".join(file.getvalue().split())
    assert "not fitted, no time left: Extra payload (link0, link1, link2), Law 0 (link0)" in text
    assert "Law 4 (link0) and 4 more" in text
    page = report.write(found, tmp_path).read_text()
    assert "no gain at first order: X (y)" in page and "Law 8 (link0)" in page


@pytest.mark.parametrize("verdict", VERDICTS)
def test_console_of_every_verdict_also_in_ascii(verdict):
    file = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
    report.console(fake.bare(verdict), file=file)
    assert WORDS[verdict].badge in file.buffer.getvalue().decode("ascii")
    report.console(fake.full(), file=file)
    assert "0.0312 +/- 0.0021 N m" in file.buffer.getvalue().decode("ascii")


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("parameters", ["shoulder.damping", "0.1070 ± 0.0020 N m s/rad"]),
        ("unexplained", ["elbow, at reversals below 0.2 rad/s", "55 % – 69 %"]),
        ("ambiguous", ["next experiment: slow triangle: separates Coulomb from Stribeck", "(next_experiment.csv)"]),
    ],
)
def test_tables_and_the_experiment_stand_below_the_verdict(verdict, words):
    file = io.StringIO()
    report.console(dataclasses.replace(fake.full(), verdict=verdict), file=file)
    advice, below = file.getvalue().split("╰")  # the verdict's frame ends
    assert all(w in below for w in words) and not any(w in advice for w in words)


@pytest.mark.parametrize("width", [80, 140])
def test_no_line_is_wider_than_the_terminal_and_no_number_parts_from_its_unit(monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    for verdict in VERDICTS:
        file = io.StringIO()
        report.console(dataclasses.replace(fake.full(), verdict=verdict), file=file)
        lines = file.getvalue().splitlines()
        assert max(map(len, lines)) <= width
        assert any("0.0312 ± 0.0021 N m" in line for line in lines)
        said = set(" ".join(lines).replace("│", " ").split())
        assert {word for text in (*fake.full().sentences, *fake.full().warnings) for word in text.split()} <= said


def test_the_terminal_has_the_order_of_the_page(tmp_path):
    """Verdict, effects in one sentence, three gaps, a command, warnings; then the rest."""
    file = io.StringIO()
    about = {"model": "Pendulum", "data": ["logs"]}
    details = fake.full().details | {"before_simulation": {"lines": ["first guess: Coulomb friction at elbow"]}}
    report.console(dataclasses.replace(fake.full(), about=about, details=details), tmp_path, file=file)
    text = " ".join(file.getvalue().replace("│", " ").split())
    gaps = "Gap: 1.8 % of the motion (21.4 noise sd) as delivered, 1.1 % of the motion (13.1 noise sd) recalibrated"
    order = ["Missing effects found", "The simulator lacks", gaps, "bayessim-mjx train --task Pendulum", "warning:"]
    rest = ["parameters", "these numbers replace the first guesses", "- Recalibrating", "candidates"]
    at = [text.index(words) for words in [*order, *rest]]
    assert at == sorted(at)


def test_what_is_told_before_the_search_fits_the_terminal(monkeypatch, capsys):
    """As many columns as there are; a second line of an item is indented."""
    from bayessim_mjx.diagnose import _told

    monkeypatch.setenv("COLUMNS", "40")
    _told("Before any simulation (1.0 s):", ["effort that the model does not explain: hinge 25 %", "short"], True)
    assert capsys.readouterr().out.splitlines() == [
        "Before any simulation (1.0 s):",
        "  effort that the model does not",
        "    explain: hinge 25 %",
        "  short",
    ]
