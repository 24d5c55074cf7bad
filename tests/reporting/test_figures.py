"""Figures: what is drawn is what was given, with units, and nothing is left behind in matplotlib."""

import json
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import synthetic
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Circle, Polygon

from lgmdjax.reporting.figures import detection, learning, locomotion, style, trajectories


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write_run(tmp_path_factory.mktemp("runs") / "made-up", frames=300, pixels=(60, 80))


@pytest.fixture(scope="module")
def drawn(run: Path) -> dict[str, Figure]:
    """Every figure, from the made-up run."""
    cpg, foot, layers, prediction, paths = (
        dict(np.load(run / name))
        for name in (
            "fit-gait/cpg.npz",
            "fit-gait/foot.npz",
            "evaluate/layers.npz",
            "train/prediction.npz",
            "evaluate/trajectories.npz",
        )
    )
    gait, calibration, training, evaluation = (
        json.loads((run / name).read_text())
        for name in (
            "fit-gait/gait.json",
            "collect/calibration.json",
            "train/training.json",
            "evaluate/evaluation.json",
        )
    )
    return {
        "rhythm": locomotion.rhythm(cpg["time"], cpg["rhythm"], 1.0, 3.1),
        "foot_paths": locomotion.foot_paths(
            **{name: foot[name] for name in ("velocities", "commanded", "simulated", "literal")}
        ),
        "gait_sweep": locomotion.gait_sweep(gait["sweep"], gait["literal"], 0.05),
        "layers": detection.layers(layers["picture"], layers["E"], layers["I"], layers["S"]),
        "calibration": detection.calibration(calibration["table"], calibration),
        "losses": learning.losses(training["curves"] | {"mean": {"train": [1.0], "test": [1.1]}}, {}),
        "stretch": learning.stretch(**prediction),
        "trajectories": trajectories.trajectories(
            synthetic.room(), {name: walks(paths, name) for name in synthetic.DRIVERS}
        ),
        "drivers": trajectories.drivers(evaluation),
        "passages": passages(paths["testing_learned"]),
    }


def passages(positions: np.ndarray) -> Figure:
    """Five ways past something, of which the first ends in a touch."""
    robots = len(positions)
    touched, across = np.arange(robots) == 0, np.linspace(0, 0.4, robots)
    rooms, ways = [synthetic.room()] * robots, list(positions[..., :2])
    return trajectories.passages(rooms, ways, touched, np.where(touched, -0.01, 0.1), across)


def walks(paths: dict[str, np.ndarray], driver: str) -> trajectories.Walks:
    return trajectories.Walks(*(paths[f"testing_{driver}{part}"] for part in ("", "_setbacks", "_contact")))


NAMES = (
    "rhythm",
    "foot_paths",
    "gait_sweep",
    "layers",
    "calibration",
    "losses",
    "stretch",
    "trajectories",
    "drivers",
    "passages",
)


def panel(figure: Figure, title: str):
    """The axes of that title, in whatever subfigure."""

    def all_axes(part: Figure | SubFigure):
        return [*part.axes, *(axes for inner in part.subfigs for axes in all_axes(inner))]

    return next(axes for axes in all_axes(figure) if axes.get_title(loc="left") == title)


@pytest.mark.parametrize("name", NAMES)
def test_numbers_on_axes_have_units(drawn: dict[str, Figure], name: str):
    labels = [text for axes in drawn[name].axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
    assert labels
    unitless = {"epoch", "collisions per 100 m"}
    assert not [label for label in labels if not label.endswith("]") and label not in unitless]


@pytest.mark.parametrize("name", NAMES)
def test_text_is_outlines_so_that_no_font_is_needed(drawn: dict[str, Figure], name: str):
    assert b"<text" not in style.to_svg(drawn[name])


def test_same_numbers_same_bytes(run: Path):
    first, second = (style.to_svg(learning.stretch(**dict(np.load(run / "train/prediction.npz")))) for _ in "12")
    assert first == second


def test_matplotlib_is_left_as_it_was(run: Path):
    before = dict(matplotlib.rcParams)
    figure = learning.stretch(**dict(np.load(run / "train/prediction.npz")))
    assert style.to_png(figure, 40).startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before


def test_each_tripod_has_a_panel_of_its_own(run: Path, drawn: dict[str, Figure]):
    outputs = np.load(run / "fit-gait/cpg.npz")["rhythm"]
    for tripod, legs in (("tripod 1, transient shaded", (0, 2, 4)), ("tripod 2", (1, 3, 5))):
        lines = panel(drawn["rhythm"], tripod).lines
        assert [line.get_label() for line in lines] == [locomotion.LEGS[leg] for leg in legs]
        for line, leg in zip(lines, legs, strict=True):
            np.testing.assert_array_equal(line.get_ydata(), outputs[:, leg])


def test_foot_paths_are_seen_from_the_side_in_millimetres(run: Path, drawn: dict[str, Figure]):
    foot = np.load(run / "fit-gait/foot.npz")
    simulated = panel(drawn["foot_paths"], "v = 2").lines[0]
    np.testing.assert_allclose(simulated.get_xdata(), 1000 * foot["simulated"][2, :, 0])
    np.testing.assert_allclose(simulated.get_ydata(), 1000 * foot["simulated"][2, :, 2])


def test_turning_left_is_up_where_the_right_side_is_faster(drawn: dict[str, Figure]):
    dots = panel(drawn["gait_sweep"], "turning").lines[1]
    steer, rate = np.asarray(dots.get_xdata()), np.asarray(dots.get_ydata())
    assert np.all(rate[steer > 0] > 0)
    assert np.all(rate[steer < 0] < 0)


def test_layers_share_one_scale(drawn: dict[str, Figure]):
    limits = {axes.get_title(loc="left")[0]: axes.images[0].get_clim() for axes in drawn["layers"].axes if axes.images}
    assert limits["1"] == (0, 255)
    assert limits["2"] == limits["3"] == limits["4"]


def test_chosen_threshold_is_the_one_marked(run: Path, drawn: dict[str, Figure]):
    chosen = json.loads((run / "collect/calibration.json").read_text())["threshold"]
    line = next(line for line in drawn["calibration"].axes[0].lines if line.get_label() == "chosen T_s")
    assert np.asarray(line.get_xdata())[0] == chosen


def test_each_weight_has_a_line_of_scores(run: Path, drawn: dict[str, Figure]):
    table = json.loads((run / "collect/calibration.json").read_text())["table"]
    lines = {line.get_label(): line for line in drawn["calibration"].axes[0].lines}
    for weight in (0.3, 0.4):
        rows = [(row["threshold"], row["score"]) for row in table if row["inhibition"] == weight]
        np.testing.assert_array_equal(lines[f"W_I = {weight}"].get_xydata(), rows)


def test_losses_are_on_one_log_axis_with_the_constant_as_a_level(drawn: dict[str, Figure]):
    training, test = panel(drawn["losses"], "training"), panel(drawn["losses"], "test")
    assert training.get_yscale() == "log"
    assert training.get_ylim() == test.get_ylim()
    assert [line.get_label() for line in test.lines] == ["lstm", "lstm-efference", "feed-forward", "mean"]
    np.testing.assert_array_equal(test.lines[-1].get_ydata(), 1.1)


def test_a_set_back_breaks_the_path_and_a_touch_is_marked(run: Path, drawn: dict[str, Figure]):
    paths = walks(dict(np.load(run / "evaluate/trajectories.npz")), "learned")
    assert np.linalg.norm(np.diff(paths.positions[0], axis=0), axis=-1).max() > 1.0, "the walk must have a set-back"
    lines = [line for line in panel(drawn["trajectories"], "learned").lines if len(np.asarray(line.get_xdata())) > 2]
    longest = max(np.linalg.norm(np.diff(line.get_xydata(), axis=0), axis=-1).max() for line in lines)
    assert longest < 0.06
    crosses = [line for line in panel(drawn["trajectories"], "learned").lines if line.get_marker() == "X"]
    marked = np.concatenate([line.get_xydata() for line in crosses if len(np.asarray(line.get_xdata()))])
    np.testing.assert_allclose(marked, paths.positions[paths.contact][:, :2])


def test_the_room_is_drawn_where_it_is(drawn: dict[str, Figure]):
    patches = panel(drawn["trajectories"], "learned").patches
    boxes = [patch for patch in patches if isinstance(patch, Polygon)]
    discs = [patch for patch in patches if isinstance(patch, Circle)]
    assert len(boxes) == 3
    assert len(discs) == 2
    assert discs[0].center == pytest.approx((-2.0, 1.5))
    assert discs[0].radius == pytest.approx(0.2)
    # A box 0.6 x 1.0 m about (2, 1), turned by 0.4 rad: its corner at (+a, +b).
    corner = 2.0 + 0.3 * np.cos(0.4) - 0.5 * np.sin(0.4), 1.0 + 0.3 * np.sin(0.4) + 0.5 * np.cos(0.4)
    assert np.min(np.linalg.norm(boxes[0].get_xy() - corner, axis=-1)) < 1e-6
    assert [box.get_linestyle() for box in boxes] == ["-", "-", "--"], "the one that hangs overhead is an outline"


def test_trajectories_without_a_room_or_other_drivers(run: Path):
    paths = walks(dict(np.load(run / "evaluate/trajectories.npz")), "learned")
    figure = trajectories.trajectories(None, {"learned": paths})
    assert not panel(figure, "learned").patches


def test_intervals_reach_from_low_to_high(run: Path, drawn: dict[str, Figure]):
    scores = json.loads((run / "evaluate/evaluation.json").read_text())["unseen"]
    axes = panel(drawn["drivers"], "unseen")
    bars = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == 2]
    assert [label.get_text() for label in axes.get_yticklabels()] == list(scores)
    for bar, score in zip(bars, scores.values(), strict=True):
        np.testing.assert_allclose(bar.get_xdata(), (score["per_100_m"]["low"], score["per_100_m"]["high"]))


def test_the_mean_over_a_second_lies_on_what_does_not_flicker(run: Path):
    series = dict(np.load(run / "train/prediction.npz"))
    series["u"] = np.stack([0.6 + 0.1 * np.sin(2 * np.pi * series["time"]), np.full(len(series["time"]), 0.7)], -1)
    axes = panel(learning.stretch(**series), "LGMD outputs: all that the learner is given")
    left, right = (line for line in axes.lines if line.get_alpha() is None)
    np.testing.assert_allclose(np.asarray(left.get_ydata())[30:-30], 0.6, atol=1e-6)
    np.testing.assert_allclose(right.get_ydata(), 0.7)


def test_passages_mark_touches_and_draw_clearance_against_the_offset(drawn):
    above, below = drawn["passages"].axes
    ends = [line for line in above.lines if line.get_marker() in ("o", "X") and len(line.get_xdata()) == 1]
    assert [line.get_marker() for line in ends].count("X") == 1
    assert "4 of 5" in above.get_title(loc="left")
    clear, touched = below.lines
    np.testing.assert_allclose(clear.get_ydata(), 10.0)
    np.testing.assert_allclose(touched.get_ydata(), 0.0)
    np.testing.assert_allclose(touched.get_xdata(), 0.0)


def test_rooms_are_drawn_side_by_side(run):
    paths = dict(np.load(run / "evaluate/trajectories.npz"))
    figure = trajectories.rooms([synthetic.room()] * 4, [walks(paths, name) for name in synthetic.DRIVERS[:4]])
    assert len(figure.axes) == 4
