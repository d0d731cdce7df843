"""Figures of every size are drawn without a warning, say what they should, and no two texts lie over each other."""

import itertools
import warnings

import numpy as np
import pytest

from bayessim_mjx.monitor import plots
from bayessim_mjx.monitor.draws import draws_of

LONG = ["hand_robot0_forearm_joint_stiffness_mult", "index_finger_proximal_damping", "slider_mass_mult"]


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def case(d, n=1500, width=0.1):
    """Posterior of standard deviation `width` (in prior ranges) round the middle of [1, 3]^d, with long names."""
    rng = np.random.default_rng(d)
    samples = np.clip(2.0 + 2.0 * width * rng.normal(size=(n, d)), 1.0, 3.0)
    names = [f"{LONG[i % 3]}" + (f"_{i}" if i > 2 else "") for i in range(d)]
    return dict(samples=samples, names=names, low=np.full(d, 1.0), high=np.full(d, 3.0), truth=np.full(d, 2.1))


def texts(figure):
    """(text, box in pixels) of all that is written."""
    figure.canvas.draw()
    renderer, off = figure.canvas.get_renderer(), undrawn_ticks(figure)
    written = figure.findobj(match=lambda artist: hasattr(artist, "get_text") and hasattr(artist, "get_fontsize"))
    shown = [t for t in written if t.get_visible() and t.get_text().strip() and id(t) not in off]
    return [(t.get_text(), t.get_window_extent(renderer)) for t in shown]


def undrawn_ticks(figure):
    """Labels of ticks outside the limits: matplotlib keeps them, but does not draw them."""
    off = set()
    for axes in figure.findobj(match=lambda artist: hasattr(artist, "get_xticklabels")):
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks():
                if not axes.axison or not low <= tick.get_loc() <= high:
                    off |= {id(tick.label1), id(tick.label2)}
    return off


def overlaps(figure):
    """Pairs of texts that share more than 2 x 2 pixels."""
    found = []
    for (a, x), (b, y) in itertools.combinations(texts(figure), 2):
        wide = min(x.x1, y.x1) - max(x.x0, y.x0)
        tall = min(x.y1, y.y1) - max(x.y0, y.y0)
        if wide > 2 and tall > 2:
            found.append((a, b))
    return found


def outside(figure):
    box = figure.bbox
    return [
        t for t, b in texts(figure) if b.x0 < box.x0 - 1 or b.x1 > box.x1 + 1 or b.y0 < box.y0 - 1 or b.y1 > box.y1 + 1
    ]


def test_the_empty_cell_of_two_parameters_has_numbers():
    figure = plots.corner(**case(2))
    words = " ".join(text for text, _ in texts(figure))
    assert "correlation" in words and "posterior/prior sd" in words
    assert overlaps(figure) == [] and outside(figure) == []


@pytest.mark.parametrize("d", [1, 2, 5])
def test_full_corner_has_one_panel_per_pair(d):
    figure = plots.corner(**case(d), round=3)
    assert len(figure.axes) == d * (d + 1) // 2
    words = " ".join(t for t, _ in texts(figure)).replace("\n", "")
    assert "Round 3: posterior over" in words and "truth" in words and "±" in words
    assert overlaps(figure) == [] and outside(figure) == []


@pytest.mark.parametrize("d", [17, 40])
@pytest.mark.slow
def test_many_parameters_are_all_listed(d):
    c = case(d)
    c["samples"][:, 7] = 2.0 + 0.1 * (c["samples"][:, 7] - 2.0)  # by far the best identified
    figure = plots.corner(**c, units=["N m/rad"] * d, round=1, best=6)
    forest = figure.axes[0]
    labels = [label.get_text() for label in forest.get_yticklabels()]
    assert len(set(labels)) == d and "index_finger" in labels[0] and all("1 to 3" in label for label in labels)
    assert len(figure.axes) == 1 + 6 * 7 // 2 + 2  # intervals, corner, heat map and its colour bar
    assert overlaps(figure) == [] and outside(figure) == []


@pytest.mark.slow
def test_a_twelve_parameter_corner_keeps_its_labels_apart():
    figure = plots.corner(**case(12, n=400), units=["kg"] * 12)
    assert len(figure.axes) == 78
    assert overlaps(figure) == [] and outside(figure) == []


def test_truth_and_prior_lines_stand_where_they_should():
    figure = plots.corner(**case(1))
    lines = figure.axes[0].lines
    assert any(np.allclose(line.get_xdata(), 2.1) for line in lines)
    assert any(np.allclose(line.get_ydata(), 0.5) for line in lines)  # uniform on [1, 3]
    assert figure.axes[0].get_xlim() == (1.0, 3.0)


def test_a_narrow_posterior_is_zoomed_and_a_truth_outside_the_range_is_seen():
    assert np.ptp(plots.corner(**case(1, width=0.005)).axes[0].get_xlim()) < 0.5
    low, high = plots.corner(**case(1) | {"truth": [3.4]}).axes[0].get_xlim()
    assert low <= 1.0 and high >= 3.4


def test_degenerate_samples_are_drawn():
    c = case(2) | {"samples": np.full((50, 2), 2.0)}
    c["samples"][0] = np.nan
    plots.corner(**c)


def test_logarithmic_axis():
    samples = 10 ** np.random.default_rng(0).normal(0, 0.2, (1000, 1))
    figure = plots.corner(samples, ["damping"], [0.01], [100.0], truth=[1.0], log=[True])
    axes = figure.axes[0]
    assert np.allclose(axes.get_xlim(), (-0.93, 0.93), atol=0.06)  # log10: 4.65 sd of 0.2
    figure.canvas.draw()
    assert "1" in [label.get_text() for label in axes.get_xticklabels()]


def test_errors_name_what_is_wrong():
    c = case(2)
    with pytest.raises(ValueError, match="names has 1 entries"):
        plots.corner(**c | {"names": ["a"]})
    with pytest.raises(ValueError, match="none of the 4 samples is finite"):
        plots.corner(**c | {"samples": np.full((4, 2), np.nan)})
    with pytest.raises(ValueError, match="truth lacks"):
        plots.corner(**c | {"truth": {"mass": 1.0}})
    with pytest.raises(ValueError, match="no parameter 'mass'"):
        plots.pair(c["samples"], "mass", 1, names=c["names"], low=c["low"], high=c["high"])


def test_pair_is_bayessimigs_two_by_two():
    c = case(3)
    options = {k: c[k] for k in ("names", "low", "high", "truth")}
    figure = plots.pair(c["samples"], 0, LONG[1], means=[[2.0, 2.0, 2.0]], log_gain=3.21, round=4, **options)
    assert len(figure.axes) == 4
    words = "\n".join(t for t, _ in texts(figure))
    for part in ("Round 4", "posterior/prior sd", "+3.21 nats", "median, 68 %", "component means"):
        assert part in words
    joint = figure.axes[2]
    markers = {line.get_marker(): line.get_xydata().tolist() for line in joint.lines}
    assert markers["*"] == [[2.1, 2.1]] and markers["+"] == [[2.0, 2.0]]
    assert overlaps(figure) == [] and outside(figure) == []


class Space:
    """Stands for a ParameterSpace with one parameter of each kind of prior."""

    names, units = ("mass", "damping", "length"), ("kg", "", "m")
    low, high = np.array([1.0, 0.01, 0.0]), np.array([3.0, 100.0, 1.0])
    parameters = tuple(type("P", (), {"prior": p}) for p in ("uniform", "loguniform", "gaussian"))

    def __len__(self):
        return 3

    def from_unit(self, u):
        u = np.asarray(u)
        return np.stack([1 + 2 * u[:, 0], 10 ** (-2 + 4 * u[:, 1]), u[:, 2] ** 2], 1)


class Posterior:
    """Stands for a Distribution: the prior itself, with two components."""

    space, prior_weight = Space(), 0.0
    logits, means = np.array([0.0, -9.0]), np.array([[0.5, 0.5, 0.5], [0.1, 0.1, 0.1]])

    def sample(self, key, n):
        return self.space.from_unit(np.random.default_rng(1).random((n, 3)))


def test_a_distribution_brings_names_ranges_prior_and_means():
    draws = draws_of(Posterior())
    assert draws.names == Space.names and draws.log.tolist() == [False, True, False]
    np.testing.assert_allclose(draws.means, [[2.0, 0.0, 0.25]], atol=1e-6)  # the second has no weight; damping as log10
    np.testing.assert_allclose(draws.numbers.width, 1.0, atol=0.05)  # the posterior is the prior
    assert len(plots.corner(Posterior(), truth={"mass": 2, "damping": 1, "length": 0.2}).axes) == 6


def test_predictive_shows_the_worst_explained_channels_first():
    rng, time = np.random.default_rng(0), np.linspace(0, 2, 50)
    real = {f"joint_{k}": np.sin(time * (3 + k)) for k in range(10)} | {"still": np.zeros(50)}
    simulated = {name: r + 0.05 * rng.normal(size=(30, 50)) for name, r in real.items()}
    simulated["joint_4"] = simulated["joint_4"] + 1.0
    simulated["joint_5"][:, 30:] = np.nan  # all episodes over
    figure = plots.predictive(time, real, simulated, units={"joint_4": "rad"}, before=simulated, round=2)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert len(titles) == 8 and titles[0].startswith("joint_4   (0 % inside")
    words = " ".join(t for t, _ in texts(figure))
    assert "Round 2" in words and "8 of 11 channels" in words and "[rad]" in words and "time [s]" in words
    assert overlaps(figure) == [] and outside(figure) == []


def test_few_channels_keep_their_places_from_round_to_round():
    time = np.linspace(0, 2, 50)
    real = {"a": np.sin(time), "b": np.cos(time)}
    for off in ({"a": 1.0, "b": 0.0}, {"a": 0.0, "b": 1.0}):
        simulated = {name: r + off[name] + np.array([[-0.1], [0.0], [0.1]]) for name, r in real.items()}
        titles = [axes.get_title(loc="left") for axes in plots.predictive(time, real, simulated).axes]
        assert [title[0] for title in titles] == ["a", "b"]


def test_a_band_that_would_hide_under_the_line_is_drawn_about_the_median():
    """A posterior of a good fit: 100 % inside of a band that nobody could see."""
    rng, time = np.random.default_rng(0), np.linspace(0, 1, 30)
    real = {"qpos:hinge": 4 * np.sin(3 * time), "qvel:hinge": 12 * np.cos(3 * time)}
    simulated = {"qpos:hinge": real["qpos:hinge"] + 0.01 * rng.normal(size=(200, 30))}
    simulated["qvel:hinge"] = real["qvel:hinge"] + 3 * rng.normal(size=(200, 30))
    figure = plots.predictive(time, real, simulated, units={"qpos:hinge": "rad", "qvel:hinge": "rad/s"})
    thin, wide = sorted(figure.axes, key=lambda axes: axes.get_ylabel(), reverse=True)
    assert thin.get_ylabel() == "minus median [rad]" and "moves by 4 rad)" in thin.get_title(loc="left")
    assert max(map(abs, thin.get_ylim())) < 0.05 and max(map(abs, wide.get_ylim())) > 12
    assert overlaps(figure) == [] and outside(figure) == []


def test_predictive_of_one_channel_and_its_errors():
    time = np.arange(5.0)
    figure = plots.predictive(time, {"a": np.zeros((2, 5))}, {"a": np.ones((1, 5))})
    assert len(figure.axes) == 1
    with pytest.raises(ValueError, match="'a' has 4 steps, but time has 5"):
        plots.predictive(time, {"a": np.zeros(4)}, {"a": np.zeros((3, 5))})
    with pytest.raises(ValueError, match="no channel in common"):
        plots.predictive(time, {"a": np.zeros(5)}, {"b": np.zeros((3, 5))})


def test_every_axis_follows_its_own_posterior_and_stays_inside_its_prior():
    """Mass 1.04 ± 0.064, length 0.5 ± 0.004 and an unknown third, all of [0.01, 2]."""
    rng, n = np.random.default_rng(0), 10_000
    samples = np.stack(
        [1.04 + 0.064 * rng.normal(size=n), 0.5 + 0.004 * rng.normal(size=n), rng.uniform(0.01, 2, n)], 1
    )
    figure = plots.corner(samples, ["mass", "length", "damping"], [0.01] * 3, [2.0] * 3, truth=[1.0, 0.5, 1.9])
    mass, length, damping = (figure.axes[k].get_xlim() for k in (0, 2, 5))
    for (low, high), mean, sd in ((mass, 1.04, 0.064), (length, 0.5, 0.004)):
        # central 98 % are 2.33 sd on either side, and half of that width again
        assert np.allclose([low, high], [mean - 4.65 * sd, mean + 4.65 * sd], atol=0.3 * sd)
    assert damping == (0.01, 2.0)
    words = [t for t, _ in texts(figure)]
    assert sum("prior 0.01 to 2" in text for text in words) == 2  # below the two that show a part of it
    assert f"{np.median(samples[:, 0]):.3f} ± 0.064" in words and overlaps(figure) == []


def test_a_posterior_at_the_end_of_its_prior_is_drawn_up_to_there():
    samples = 1.0 + np.abs(0.05 * np.random.default_rng(0).normal(size=(5000, 1)))
    low, high = plots.corner(samples, ["mass"], [1.0], [3.0]).axes[0].get_xlim()
    assert low == 1.0 and 1.1 < high < 1.4
    low, high = plots.corner(samples, ["mass"], [1.0], [3.0], truth=[2.5]).axes[0].get_xlim()
    assert low == 1.0 and 2.5 < high < 2.6


def test_joint_densities_are_interpolated():
    figure = plots.corner(**case(2))
    [picture] = figure.axes[1].images
    assert picture.get_interpolation() == "bicubic"


def report_of(d, pairs=300):
    """A calibrated report of d parameters, with 95 % regions that hold 93 %."""
    from types import SimpleNamespace

    rng, names = np.random.default_rng(d), tuple(f"left_front_leg_{i}_stiffness_mult" for i in range(d))
    ranks = SimpleNamespace(level=rng.random(pairs), tarp=rng.random(pairs), parameters=rng.random((pairs, d)))
    coverage = {0.5: (0.55, 0.029), 0.8: (0.81, 0.023), 0.95: (0.93, 0.013)}
    p = dict.fromkeys((*names, "HPD level", "TARP"), 0.5)
    return SimpleNamespace(
        pairs=pairs, names=names, words="calibrated", p=p, coverage=coverage, ranks=ranks,
        intervals=dict, interval_coverage=dict, limit=0.001, moments=dict, moment_limit=0.002,
    )  # fmt: skip


@pytest.mark.parametrize("d", [2, 13])
def test_all_that_a_calibration_picture_says_is_inside_of_it(d):

    figure = plots.calibration(report_of(d), round=2)
    assert overlaps(figure) == [] and outside(figure) == []
    words = texts(figure)
    [(_, table)] = [(text, box) for text, box in words if "95 %:  93 ± 1 %" in text]
    axes = figure.axes[0].get_window_extent()
    assert axes.x0 < table.x0 and table.x1 < axes.x1 and axes.y0 < table.y0 and table.y1 < axes.y1
    assert sum("(p = " in text for text, _ in words) == min(d, 8)


def test_a_calibration_picture_shows_the_intervals_that_its_title_rests_on():
    """The regions of all parameters hold enough, the intervals of one do not: both are drawn, and the latter named."""
    from bayessim_mjx.inference import calibration
    from bayessim_mjx.parameters import Parameter, ParameterSpace

    rng, n = np.random.default_rng(0), 3000
    pit = np.stack([0.5 + np.clip((rng.random(n) - 0.5) / 0.8, -0.5, 0.5), rng.random(n)], axis=1)
    even, space = rng.random(n), ParameterSpace([Parameter(name, 1.0, 0.5, 2.0) for name in ("mass", "length")])
    report = calibration.judge(calibration.Ranks(pit, even, rng.random(n), even, np.ones((n, 2))), space)
    figure = plots.calibration(report, round=1, replaced=True)
    words = [text for text, _ in texts(figure)]
    assert "intervals of mass" in words and any("in use is that of the replays" in text for text in words)
    assert any("intervals of mass\n50 %:  40" in text for text in words)
    assert any(text.startswith("mass (p = ") and "; spread p < 1e-9)" in text for text in words)
    assert any("p below 0.000625; of mean or spread of ranks, below 0.00125" in text for text in words)
    assert sum(f"TARP, p = {report.p['TARP']:.2g}" in text for text in words) == 1
    title = " ".join(next(text for text in words if "network's posterior" in text).split())
    assert "too narrow in mass, by the spread of the ranks (p < 1e-9, a fault below 0.00125)" in title
    assert overlaps(figure) == [] and outside(figure) == []


def test_a_calibration_picture_shows_posteriors_of_several_trajectories():
    from bayessim_mjx.inference.product_calibration import Count, Sets

    even = (np.arange(64) + 0.5) / 64
    sets = Sets(tuple(Count(n, 1.2, 2.0 + n, 0.1, 2.0, even) for n in (1, 2, 4, 8, 11)))
    figure = plots.calibration(report_of(2), round=2, sets=sets)
    assert overlaps(figure) == [] and outside(figure) == []
    words = [text for text, _ in texts(figure)]
    assert any("each of the 11 trajectories" in " ".join(text.split()) for text in words) and "13.0" in words
    assert figure.axes[2].get_xlabel() == "trajectories"


def test_predictive_axes_name_quantity_joint_and_unit():
    time = np.linspace(0, 1, 20)
    real = {f"{stream}:{joint}": np.sin(time) for stream in ("qpos", "qvel") for joint in ("elbow", "rail")}
    units = {"qpos:elbow": "rad", "qvel:elbow": "rad/s", "qpos:rail": "m", "qvel:rail": "m/s"}
    figure = plots.predictive(
        time, real, {k: v + np.array([[-0.3], [0.0], [0.3]]) for k, v in real.items()}, units=units, own="true motion"
    )
    assert "true motion" in [text for text, _ in texts(figure)]
    labels = {axes.get_ylabel().replace("\n", " ") for axes in figure.axes}
    assert labels == {
        "angle of elbow [rad]", "angular velocity of elbow [rad/s]", "position of rail [m]", "velocity of rail [m/s]",
    }  # fmt: skip
    assert any(axes.get_title(loc="left").startswith("elbow, angle   (") for axes in figure.axes)
    assert overlaps(figure) == [] and outside(figure) == []
