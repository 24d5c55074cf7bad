"""Style of all figures: size, colours, matplotlib settings, and the conversion to SVG and PNG.

The plot functions of this folder return a matplotlib `Figure` about 18 cm wide. They use the Agg canvas without pyplot,
so they need no window system and leave no global figure behind. Left is blue and right is orange throughout, in the
palette of Okabe & Ito, which colour-blind readers can tell apart.

| figure                                        | of the paper | shows                                                |
| --------------------------------------------- | ------------ | ---------------------------------------------------- |
| `locomotion.plot_cpg_outputs`                 | 5b           | outputs of the six CPG units from a random start     |
| `locomotion.plot_foot_paths`                  | 5c           | path of leg 1's foot, commanded and simulated        |
| `locomotion.plot_gait_sweep`                  | -            | speed and turning, commanded and simulated           |
| `detection.plot_lgmd_layers`                  | 6b           | picture, E, I and S of one eye                       |
| `detection.plot_grid_search`                  | -            | score of the candidates for T_s and W_I              |
| `learning.plot_losses`                        | 11           | training and test error of every learner             |
| `learning.plot_predictions`                   | 12           | u, e, the rule's v and the learned v over time       |
| `trajectories.plot_trajectories`              | 13           | walks of all policies in one room                    |
| `trajectories.plot_walks`                     | -            | walks of a record in their rooms                     |
| `trajectories.plot_passages`                  | 14, 16       | paths past an obstacle                               |
| `comparison.plot_collision_rates`             | -            | collisions per 100 m of every policy, with intervals |
| `comparison.plot_collisions_against_coverage` | -            | the same against the coverage of every policy        |
| `stimulus_scores.plot`                        | -            | looming detectors on laboratory stimuli              |
| `sweeps.plot`                                 | -            | measures of a sweep against its settings             |
| `clip_scores.plot_roc`, `plot_clip`           | -            | looming detectors on video clips                     |
| `detector_fits.plot`                          | -            | looming detectors before and after a fit by gradient |
| `detector_walks.plot`                         | -            | looming detectors as the eyes of one robot           |
"""

import io
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec

import matplotlib
from cycler import cycler
from matplotlib.figure import Figure

_P = ParamSpec("_P")

WIDTH = 7.2  # inches, width of the report's column
LEFT_COLOUR, RIGHT_COLOUR = "#0072B2", "#D55E00"
DARK, GREY, LIGHT_GREY, OBSTACLE_COLOUR, RED = "#222222", "#767676", "#dddddd", "#c9c5bd", "#c1121f"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
POLICY_COLOURS: dict[str, str] = {
    "teacher": "#009E73",
    "learned": "#0072B2",
    "blind": "#555555",
    "direct": "#CC79A7",
    "random": "#E69F00",
}
STYLE: dict[Any, object] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": DARK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=PALETTE),
    "grid.color": "#ececec",
    "grid.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": DARK,
    "ytick.labelcolor": DARK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "butt",
    "text.color": DARK,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "lgmdjax",
}


def styled(plot: Callable[_P, Figure]) -> Callable[_P, Figure]:
    """Decorate a plot function so that it plots in the report's style and leaves matplotlib's settings unchanged."""

    @wraps(plot)
    def wrapper(*args: _P.args, **kwargs: _P.kwargs) -> Figure:
        with matplotlib.rc_context(STYLE):
            return plot(*args, **kwargs)

    return wrapper


def to_svg(figure: Figure) -> bytes:
    """Convert a figure to SVG with text as outlines; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def to_png(figure: Figure, dpi: float = 150.0) -> bytes:
    """Convert a figure to PNG."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
