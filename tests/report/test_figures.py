"""Figures of the page whose numbers could make them unreadable."""

from bayessim_mjx.report import gap_figures, rival_figures
from bayessim_mjx.report.look import COLUMN

STAGES = {"nominal": 4.0, "calibrated": 2.0, "with_effects": 1.0, "noise_floor": 1.0}


def test_a_wide_interval_leaves_room_for_the_bars():
    """Twice the gap is four times its square, far above what is drawn; the label has it then."""
    drawn = gap_figures.waterfall(STAGES | {"ci": {"nominal": (3.0, 8.0)}}, [])
    assert drawn["layout"]["yaxis"]["range"][1] < 1.1 * gap_figures.HIGHEST + 1e-9
    first = next(t for t in drawn["data"] if "error_y" in t)["error_y"]["array"][0]
    assert abs(first - (gap_figures.HIGHEST - 1.0)) < 1e-9
    assert drawn["layout"]["annotations"][0]["text"] == "<b>4.00</b> (3.00 to 8.00)"
    narrow = gap_figures.waterfall(STAGES | {"ci": {"nominal": (3.0, 5.0)}}, [])
    assert narrow["layout"]["annotations"][0]["text"] == "<b>4.00</b>"


def test_a_figure_beside_a_table_is_no_wider_than_its_column():
    drawn = rival_figures.importance([{"input": "hinge speed", "importance": 2.0}])
    assert drawn["width"] == drawn["least"] == COLUMN
