"""What is remarked of known parameters, in sentences."""

from bayessim_mjx.diagnosis.phrases import parameters as phrases
from bayessim_mjx.diagnosis.phrases.parameters import remarks


def parameter(mean: float, structural: str = "", away: float | None = None) -> dict:
    sheet = {} if away is None else {"data_sheet": phrases.far_from_data_sheet(mean, away), "away": away}
    at_bound = structural == phrases.stuck(mean)
    return {"mean": mean, "structural": structural, "at_bound": at_bound, "data_sheet": "", **sheet}


def test_one_parameter_has_its_own_sentence():
    known = {"mass": parameter(1.2, phrases.stuck(1.2), 4.0), "damping": parameter(1.0)}
    bound, far = remarks(known)
    assert bound == f"mass {phrases.stuck(1.2)}." and far == "mass is 1.2, 4.0 sd from the data sheet."


def test_several_share_one():
    known = {name: parameter(0.8, phrases.stuck(0.8), 4.0) for name in ("hip", "thigh")}
    known |= {"calf": parameter(0.868, away=2.64), "foot": parameter(1.0, phrases.moves(0.2, 3))}
    moves, bound, far = remarks(known)
    assert moves == f"foot {phrases.moves(0.2, 3)}."
    assert bound.startswith("At a bound: hip 0.8 and thigh 0.8.")
    assert far == "Far from the data sheet: hip 0.8 (4.0 sd), thigh 0.8 (4.0 sd) and calf 0.868 (2.6 sd)."
    assert remarks({"mass": parameter(1.0)}) == []
