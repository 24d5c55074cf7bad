"""The figures of the report: numbers in, a matplotlib `Figure` out, nothing read and nothing kept.

Every function draws one figure for a page about 18 cm wide, on the Agg canvas and without pyplot, so that no
window system and no global figure is involved. Left is blue and right is orange throughout, in the palette of
Okabe & Ito, which stays apart for colour-blind eyes. The file is long because it is eleven times the same kind of
thing: the functions share a style and nothing else.

| figure here    | of the paper | shows                                                   |
| -------------- | ------------ | ------------------------------------------------------- |
| `rhythm`       | 5b           | outputs of the six CPG units from a random start        |
| `foot_paths`   | 5c           | path of leg 1's foot, commanded and simulated           |
| `gait_sweep`   | -            | speed and turning asked for and walked                  |
| `layers`       | 6b           | picture, E, I and S of one eye                          |
| `calibration`  | -            | score of the candidates for T_s and W_I                 |
| `losses`       | 11           | training and test error of every learner                |
| `stretch`      | 12           | u, d, the rule's v and the learner's v side by side     |
| `trajectories` | 13           | walks in a room, with its obstacles                     |
| `rooms`        | -            | walks in several rooms                                  |
| `passages`     | 14, 16       | ways past what stands in the way                        |
| `drivers`      | -            | collisions per 100 m of every driver, with intervals    |
"""

import io
from collections.abc import Callable
from functools import wraps
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.figure import Figure

WIDTH = 7.2  # inches, the width of the report's column
LEFT, RIGHT = "#0072B2", "#D55E00"
INK, QUIET, FAINT, OBSTACLE, ALARM = "#222222", "#767676", "#dddddd", "#c9c5bd", "#c1121f"
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DRIVERS = {
    "teacher": "#009E73",
    "learned": "#0072B2",
    "blind": "#555555",
    "direct": "#CC79A7",
    "random": "#E69F00",
}
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=PALETTE),
    "grid.color": "#ececec",
    "grid.linewidth": 0.7,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "butt",
    "text.color": INK,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "path",
    "svg.hashsalt": "lgmdjax",
}


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Draw under the report's style, and leave matplotlib's settings as they were."""

    @wraps(draw)
    def wrapper(*args: Any, **kwargs: Any) -> Figure:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapper


def to_svg(figure: Figure) -> bytes:
    """Write a figure as SVG with text as outlines, the same bytes for the same figure."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def to_png(figure: Figure, dpi: float = 150.0) -> bytes:
    """Write a figure as PNG."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
