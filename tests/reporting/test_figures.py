"""Figures: they plot the given data, have units, and leave matplotlib's settings unchanged."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import synthetic
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Circle, Polygon

from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.reporting.figures import comparison, detection, learning, locomotion, style, trajectories
from lgmdjax.simulation.closed_loop import Room


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.write_run(tmp_path_factory.mktemp("runs") / "made-up", frames=300, pixels=(60, 80))


@pytest.fixture(scope="module")
def figures(run: Path) -> dict[str, Figure]:
    """Every figure, plotted from the synthetic run."""
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
        "cpg_outputs": locomotion.plot_cpg_outputs(cpg["time"], cpg["rhythm"], 1.0, 3.1),
        "foot_paths": locomotion.plot_foot_paths(
            **{name: foot[name] for name in ("velocities", "commanded", "simulated", "literal")}
        ),
        "gait_sweep": locomotion.plot_gait_sweep(gait["sweep"], gait["literal"], 0.05),
        "lgmd_layers": detection.plot_lgmd_layers(layers["picture"], layers["E"], layers["I"], layers["S"]),
        "grid_search": detection.plot_grid_search(calibration["table"], calibration),
        "losses": learning.plot_losses(training["curves"] | {"mean": {"train": [1.0], "test": [1.1]}}, {}),
        "predictions": learning.plot_predictions(**prediction),
        "trajectories": trajectories.plot_trajectories(
            synthetic.room(), {name: paths_of(paths, name) for name in POLICY_NAMES}
        ),
        "collision_rates": comparison.plot_collision_rates(evaluation),
        "coverage": comparison.plot_collisions_against_coverage(evaluation),
        "passages": passages(paths["testing_learned"]),
    }


def passages(positions: np.ndarray) -> Figure:
    """Plot five paths past an obstacle, the first of which ends with a contact."""
    robots = len(positions)
    touched, offsets = np.arange(robots) == 0, np.linspace(0, 0.4, robots)
    rooms, paths = [synthetic.room()] * robots, list(positions[..., :2])
    return trajectories.plot_passages(rooms, paths, touched, np.where(touched, -0.01, 0.1), offsets)


def paths_of(arrays: dict[str, np.ndarray], policy: str) -> trajectories.Paths:
    return trajectories.Paths(*(arrays[f"testing_{policy}{part}"] for part in ("", "_resets", "_contact")))


NAMES = (
    "cpg_outputs",
    "foot_paths",
    "gait_sweep",
    "lgmd_layers",
    "grid_search",
    "losses",
    "predictions",
    "trajectories",
    "collision_rates",
    "coverage",
    "passages",
)


def panel(figure: Figure, title: str):
    """Return the axes with a title, in any subfigure."""

    def all_axes(part: Figure | SubFigure):
        return [*part.axes, *(axes for inner in part.subfigs for axes in all_axes(inner))]

    return next(axes for axes in all_axes(figure) if axes.get_title(loc="left") == title)


@pytest.mark.parametrize("name", NAMES)
def test_numbers_on_axes_have_units(figures: dict[str, Figure], name: str):
    labels = [text for axes in figures[name].axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text]
    assert labels
    unitless = {"epoch", "collisions per 100 m"}
    assert not [label for label in labels if not label.endswith("]") and label not in unitless]


@pytest.mark.parametrize("name", NAMES)
def test_text_is_converted_to_outlines(figures: dict[str, Figure], name: str):
    assert b"<text" not in style.to_svg(figures[name])


def test_the_same_data_gives_the_same_bytes(run: Path):
    first, second = (
        style.to_svg(learning.plot_predictions(**dict(np.load(run / "train/prediction.npz")))) for _ in "12"
    )
    assert first == second


def test_settings_of_matplotlib_are_unchanged(run: Path):
    before = dict(matplotlib.rcParams)
    figure = learning.plot_predictions(**dict(np.load(run / "train/prediction.npz")))
    assert style.to_png(figure, 40).startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before


def test_each_tripod_has_its_own_panel(run: Path, figures: dict[str, Figure]):
    outputs = np.load(run / "fit-gait/cpg.npz")["rhythm"]
    for tripod, legs in (("tripod 1, transient shaded", (0, 2, 4)), ("tripod 2", (1, 3, 5))):
        lines = panel(figures["cpg_outputs"], tripod).lines
        assert [line.get_label() for line in lines] == [locomotion.LEG_NAMES[leg] for leg in legs]
        for line, leg in zip(lines, legs, strict=True):
            np.testing.assert_array_equal(line.get_ydata(), outputs[:, leg])


def test_foot_paths_are_plotted_from_the_side_in_millimetres(run: Path, figures: dict[str, Figure]):
    foot = np.load(run / "fit-gait/foot.npz")
    simulated = panel(figures["foot_paths"], "v = 2").lines[0]
    np.testing.assert_allclose(simulated.get_xdata(), 1000 * foot["simulated"][2, :, 0])
    np.testing.assert_allclose(simulated.get_ydata(), 1000 * foot["simulated"][2, :, 2])


def test_the_yaw_rate_is_positive_where_the_right_side_is_faster(figures: dict[str, Figure]):
    dots = panel(figures["gait_sweep"], "turning").lines[1]
    steer, rate = np.asarray(dots.get_xdata()), np.asarray(dots.get_ydata())
    assert np.all(rate[steer > 0] > 0)
    assert np.all(rate[steer < 0] < 0)


def test_layers_share_one_scale(figures: dict[str, Figure]):
    limits = {
        axes.get_title(loc="left")[0]: axes.images[0].get_clim() for axes in figures["lgmd_layers"].axes if axes.images
    }
    assert limits["1"] == (0, 255)
    assert limits["2"] == limits["3"] == limits["4"]


def test_the_chosen_threshold_is_marked(run: Path, figures: dict[str, Figure]):
    chosen = json.loads((run / "collect/calibration.json").read_text())["threshold"]
    line = next(line for line in figures["grid_search"].axes[0].lines if line.get_label() == "chosen T_s")
    assert np.asarray(line.get_xdata())[0] == chosen


def test_each_weight_has_its_own_line(run: Path, figures: dict[str, Figure]):
    table = json.loads((run / "collect/calibration.json").read_text())["table"]
    lines = {line.get_label(): line for line in figures["grid_search"].axes[0].lines}
    for weight in (0.3, 0.4):
        rows = [(row["threshold"], row["score"]) for row in table if row["inhibition"] == weight]
        np.testing.assert_array_equal(lines[f"W_I = {weight}"].get_xydata(), rows)


def test_losses_share_a_log_axis_and_a_single_value_is_a_horizontal_line(figures: dict[str, Figure]):
    training, test = panel(figures["losses"], "training"), panel(figures["losses"], "test")
    assert training.get_yscale() == "log"
    assert training.get_ylim() == test.get_ylim()
    assert [line.get_label() for line in test.lines] == ["lstm", "lstm-efference", "feed-forward", "mean"]
    np.testing.assert_array_equal(test.lines[-1].get_ydata(), 1.1)


def test_a_reset_interrupts_the_path_and_a_collision_is_marked(run: Path, figures: dict[str, Figure]):
    paths = paths_of(dict(np.load(run / "evaluate/trajectories.npz")), "learned")
    assert np.linalg.norm(np.diff(paths.positions[0], axis=0), axis=-1).max() > 1.0, "the walk must have a reset"
    lines = [line for line in panel(figures["trajectories"], "learned").lines if len(np.asarray(line.get_xdata())) > 2]
    longest = max(np.linalg.norm(np.diff(line.get_xydata(), axis=0), axis=-1).max() for line in lines)
    assert longest < 0.06
    crosses = [line for line in panel(figures["trajectories"], "learned").lines if line.get_marker() == "X"]
    marked = np.concatenate([line.get_xydata() for line in crosses if len(np.asarray(line.get_xdata()))])
    np.testing.assert_allclose(marked, paths.positions[paths.contact][:, :2])


def test_obstacles_are_plotted_at_their_positions(figures: dict[str, Figure]):
    patches = panel(figures["trajectories"], "learned").patches
    boxes = [patch for patch in patches if isinstance(patch, Polygon)]
    discs = [patch for patch in patches if isinstance(patch, Circle)]
    assert len(boxes) == 3
    assert len(discs) == 2
    assert discs[0].center == pytest.approx((-2.0, 1.5))
    assert discs[0].radius == pytest.approx(0.2)
    # A box of 0.6 x 1.0 m at (2, 1), rotated by 0.4 rad: its corner at (+a, +b).
    corner = 2.0 + 0.3 * np.cos(0.4) - 0.5 * np.sin(0.4), 1.0 + 0.3 * np.sin(0.4) + 0.5 * np.cos(0.4)
    assert np.min(np.linalg.norm(boxes[0].get_xy() - corner, axis=-1)) < 1e-6
    assert [box.get_linestyle() for box in boxes] == ["-", "-", "--"], "the overhead one is dashed"


def test_trajectories_without_a_room_and_other_policies(run: Path):
    paths = paths_of(dict(np.load(run / "evaluate/trajectories.npz")), "learned")
    figure = trajectories.plot_trajectories(None, {"learned": paths})
    assert not panel(figure, "learned").patches


def test_intervals_range_from_low_to_high(run: Path, figures: dict[str, Figure]):
    scores = json.loads((run / "evaluate/evaluation.json").read_text())["unseen"]
    axes = panel(figures["collision_rates"], "unseen")
    bars = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == 2]
    assert [label.get_text() for label in axes.get_yticklabels()] == list(scores)
    for bar, score in zip(bars, scores.values(), strict=True):
        np.testing.assert_allclose(bar.get_xdata(), (score["per_100_m"]["low"], score["per_100_m"]["high"]))


def test_the_mean_over_a_second_equals_a_constant_u(run: Path):
    series = dict(np.load(run / "train/prediction.npz"))
    series["u"] = np.stack([0.6 + 0.1 * np.sin(2 * np.pi * series["time"]), np.full(len(series["time"]), 0.7)], -1)
    axes = panel(learning.plot_predictions(**series), "LGMD outputs: input of the learned policy")
    left, right = (line for line in axes.lines if line.get_alpha() is None)
    np.testing.assert_allclose(np.asarray(left.get_ydata())[30:-30], 0.6, atol=1e-6)
    np.testing.assert_allclose(right.get_ydata(), 0.7)


def test_passages_mark_contacts_and_plot_clearance_over_the_offset(figures):
    above, below = figures["passages"].axes
    ends = [line for line in above.lines if line.get_marker() in ("o", "X") and len(line.get_xdata()) == 1]
    assert [line.get_marker() for line in ends].count("X") == 1
    assert "4 of 5" in above.get_title(loc="left")
    clear, touched = below.lines
    np.testing.assert_allclose(clear.get_ydata(), 10.0)
    np.testing.assert_allclose(touched.get_ydata(), 0.0)
    np.testing.assert_allclose(touched.get_xdata(), 0.0)


def test_rooms_are_plotted_side_by_side(run):
    paths = dict(np.load(run / "evaluate/trajectories.npz"))
    figure = trajectories.plot_rooms([synthetic.room()] * 4, [paths_of(paths, name) for name in POLICY_NAMES[:4]])
    assert len(figure.axes) == 4


def test_walks_of_a_record_have_a_panel_per_room():
    record = synthetic.walk(4, 300)
    arenas = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), synthetic.room())
    rooms = Room(arena=arenas, starts=jnp.zeros((4, 1, 3)), key=jax.random.split(jax.random.key(0), 4))
    for given, panels, paths in ((rooms, 4, 1), (arenas, 4, 1), (synthetic.room(), 1, 4), (None, 1, 4)):
        figure = trajectories.plot_walks(record, given)
        assert len(figure.axes) == panels
        lines = [line for line in figure.axes[0].lines if line.get_alpha() == 0.85]
        assert len(lines) == paths
        assert len(figure.axes[0].patches) == (0 if given is None else 6), "walls and five obstacles"
    one = trajectories.plot_walks(jax.tree.map(lambda leaf: leaf[0], record), synthetic.room())
    assert len(one.axes) == 1
