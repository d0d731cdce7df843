"""Table, titles, curves, describe() and JSON say the same of one posterior whose width is known beforehand."""

import dataclasses
import io
import json
import re
import types

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from bayessim_mjx import loop, main
from bayessim_mjx.distributions import Distribution, Gaussian, GaussianMixture
from bayessim_mjx.loop.round_inference import score
from bayessim_mjx.monitor import plots, session
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("mass", 1.0, 0.01, 2.0), Parameter("length", 1.0, 0.01, 2.0)])
MEAN, SD, RHO, KEPT = (1.003, 0.5), (0.0022, 0.0002), -0.13, 1e-4
PRIOR_SD = 1.99 / 12**0.5  # the kept share alone has the sd (1e-4 (.574^2 + .505^2))^.5 = .0076 in length: 38 SD


def known(share: float = KEPT) -> Distribution:
    cross = RHO * SD[0] * SD[1]
    q = Gaussian(SPACE, MEAN, [[SD[0] ** 2, cross], [cross, SD[1] ** 2]])
    return dataclasses.replace(q, prior_weight=jnp.float32(share))


def closing_table(q: Distribution) -> str:
    out = io.StringIO()
    parts = types.SimpleNamespace(
        settings=types.SimpleNamespace(modelClass="MDN"), source=types.SimpleNamespace(truth=np.array([1.0, 0.5]))
    )
    with Console(file=out) as console:
        main._report(console, parts, types.SimpleNamespace(domain=q))
    return out.getvalue()


def row_of(q: Distribution, tmp_path) -> dict:
    """The line of rounds.jsonl."""
    info = loop.RoundInfo(
        round=0, rounds=1, domain=q, posterior=q, truth=None, returns=np.zeros(1), lengths=np.zeros(1), real=None,
        predictive=None, fit={}, scores=score(q, None), seconds={}, warnings=[],
    )  # fmt: skip
    session.Session._note(types.SimpleNamespace(path=tmp_path), info)
    return json.loads((tmp_path / "rounds.jsonl").read_text()) | {"line": session.round_line(info)}


def spread_of(line) -> float:
    x, y = line.get_xdata(), line.get_ydata()
    mean = np.sum(x * y) / np.sum(y)
    return float(np.sqrt(np.sum((x - mean) ** 2 * y) / np.sum(y)))


def test_every_view_has_the_posteriors_width_not_that_of_the_prior_it_keeps(tmp_path):
    q = known()
    assert float(q.sd()[1]) == pytest.approx(0.0076, rel=0.02)  # of all draws, as training has them
    described = q.describe()
    for name, mean, sd in zip(SPACE.names, MEAN, SD, strict=True):
        row = described[name]
        assert row["sd"] == pytest.approx(sd, rel=0.03) and row["mean"] == pytest.approx(mean, abs=0.02 * sd)
        assert row["median"] == pytest.approx(mean, abs=0.05 * sd)
        assert [row["q16"] - mean, row["q84"] - mean] == pytest.approx([-sd, sd], rel=0.04)
        assert 1 - row["contraction"] == pytest.approx((sd / PRIOR_SD) ** 2, rel=0.08)
    table = closing_table(q)
    assert "1.0030 ± 0.0022" in table and "0.50000 ± 0.00020" in table and "0.00035" in table
    assert "also draws 0.010 % of its physics from the prior" in table
    assert table.index("length") < table.index("mass")  # 11 times the better known
    figure = plots.corner(q)
    titles = {axes.get_title() for axes in figure.axes}
    assert {"1.0030 ± 0.0022", "0.50000 ± 0.00020"} <= titles
    curves = [max(axes.lines, key=lambda line: len(line.get_xdata())) for axes in (figure.axes[0], figure.axes[2])]
    for curve, sd in zip(curves, SD, strict=True):
        assert spread_of(curve) == pytest.approx(sd, rel=0.1)  # drawn with a bandwidth of n^(-1/5) = .16 sd
    facts = " ".join(t.get_text() for t in plots.pair(q).axes[1].texts)
    assert "1.0030 ± 0.0022" in facts and "0.50000 ± 0.00020" in facts
    assert float(re.search(r"correlation +(\S+)", facts)[1]) == pytest.approx(RHO, abs=0.03)
    row = row_of(q, tmp_path)
    assert row["posterior"] == described and row["prior_share"] == pytest.approx(KEPT)
    assert row["scores"]["width/length"] == pytest.approx(SD[1] / PRIOR_SD, rel=0.05)
    assert row["line"]["widths"] == pytest.approx({"length": SD[1] / PRIOR_SD, "mass": SD[0] / PRIOR_SD}, rel=0.05)


def test_samples_of_the_same_gaussian_have_the_same_numbers():
    draws = np.random.default_rng(0).normal(MEAN[1], SD[1], (20_000, 1))
    (title,) = (axes.get_title() for axes in plots.corner(draws, ["length"], [0.01], [2.0]).axes)
    assert title == "0.50000 ± 0.00020"


def test_a_skewed_posterior_is_told_by_median_and_interval():
    """An exponential of .1 above .5: quantiles -log(1 - p) / 10, far from the mean .6 and the sd .1."""
    p = (np.arange(400) + 0.5) / 400
    points = 0.5 - 0.1 * np.log1p(-p)
    q = GaussianMixture(SPACE, np.full(400, 1 / 400), np.stack([points, np.full(400, 0.5)], 1), [[2e-3, 1e-2]] * 400)
    low, median, high = 0.5 - 0.1 * np.log1p(-norm.cdf([-1.0, 0.0, 1.0]))
    row = q.describe()["mass"]
    assert [row["q16"], row["median"], row["q84"]] == pytest.approx([low, median, high], abs=0.002)
    found = re.search(r"mass +0.01 to 2 +(\S+) \+(\S+)/-(\S+)", closing_table(q))
    assert [float(x) for x in found.groups()] == pytest.approx([median, high - median, median - low], abs=0.003)


def test_what_is_mostly_the_prior_is_told_as_the_prior():
    flat = known(0.9)
    assert flat.describe()["length"]["sd"] == pytest.approx(0.566, abs=0.005)  # (.9 .574^2 + .09 .505^2)^.5
    assert "these are numbers of the prior: 90 %" in closing_table(flat)
