"""Figures of the page whose numbers could make them unreadable."""

import pytest

from bayessim_mjx.report import evidence, gap_figures, rival_figures
from bayessim_mjx.report.look import COLUMN

STAGES = {"nominal": 4.0, "calibrated": 2.0, "with_effects": 1.0, "noise_floor": 1.0}


def test_a_wide_interval_leaves_room_for_the_bars():
    """Twice the gap is four times its square, far above what is drawn; the label has it then."""
    drawn = gap_figures.waterfall(STAGES | {"ci": {"nominal": (3.0, 8.0)}}, [])
    assert drawn["layout"]["xaxis"]["range"][1] < 1.5 * gap_figures.HIGHEST
    first = next(t for t in drawn["data"] if "error_x" in t)["error_x"]["array"][0]
    assert abs(first - (gap_figures.HIGHEST - 1.0)) < 1e-9
    assert drawn["layout"]["annotations"][0]["text"] == "<b>4.00</b><br>(3.00 to 8.00)"
    narrow = gap_figures.waterfall(STAGES | {"ci": {"nominal": (3.0, 5.0)}}, [])
    assert narrow["layout"]["annotations"][0]["text"] == "<b>4.00</b>"


def test_a_figure_beside_a_table_is_no_wider_than_its_column():
    drawn = rival_figures.importance([{"input": "hinge speed", "importance": 2.0}])
    assert drawn["least"] <= drawn["width"] == COLUMN


def test_the_waterfall_fits_a_phone():
    """Names stand left of the rows, in lines that are no longer than their margin; nothing is cut at 360 px."""
    shares = [{"effect": "direction_dependent_friction@left_front_shoulder", "share": 1.0}]
    drawn = gap_figures.waterfall(STAGES, shares)
    names = drawn["layout"]["yaxis"]["ticktext"]
    assert drawn["least"] <= 332 and names[0] == "as delivered" and len(names) == len(drawn["data"][0]["y"])
    assert all(len(line) <= 24 for name in names for line in name.split("<br>"))
    assert all(t["orientation"] == "h" for t in drawn["data"] if t["type"] == "bar")


def test_estimates_per_condition_are_drawn_about_the_tables_value():
    """Conditions at .98 and 1.02 about the simulated 1.0 lie at 1.08 and 1.12 about the robot's 1.1."""
    moved = evidence._of_robot({"mean": [0.98, 1.02], "sd": [0.1, 0.1]}, {"mean": 1.1, "simulated": 1.0})
    assert moved["mean"] == pytest.approx([1.08, 1.12]) and moved["sd"] == [0.1, 0.1]
    assert evidence._of_robot({"mean": [0.98]}, {"mean": 1.1})["mean"] == [0.98]
