"""Plots of the LGMD: its layers, and the grid search for its thresholds."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy import ndarray

from lgmdjax.reporting.figures.style import RED, WIDTH, styled
from lgmdjax.runtime.storage import JsonObject


@styled
def plot_lgmd_layers(
    picture: Float[ndarray, "height width"],
    excitation: Float[ndarray, "height width"],
    inhibition: Float[ndarray, "height width"],
    summation: Float[ndarray, "height width"],
) -> Figure:
    """Plot one eye's picture and the three layers of its LGMD (fig. 6b), in grey levels.

    E, I and S share one scale, so that they can be compared; its top is the 99.5th percentile of E.
    """
    height, width = picture.shape
    figure = Figure(figsize=(WIDTH, 2 * 0.44 * WIDTH * height / width + 0.75))
    panels = figure.subplots(2, 2).ravel()
    top = max(float(np.percentile(np.abs(excitation), 99.5)), 1e-6)
    shown = (picture, np.abs(excitation), np.abs(inhibition), summation)
    titles = ("1  picture L", "2  excitation E", "3  inhibition |I|", "4  summation S = E - W_I |I|")
    images = []
    for axes, layer, title in zip(panels, shown, titles, strict=True):
        is_picture = layer is picture
        limits = {"vmin": 0, "vmax": 255} if is_picture else {"vmin": 0, "vmax": top}
        images.append(axes.imshow(layer, cmap="gray" if is_picture else "inferno", interpolation="nearest", **limits))
        axes.set_title(title)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    figure.colorbar(images[0], ax=panels[:2].tolist(), shrink=0.9, label="grey level [0..255]", pad=0.01)
    figure.colorbar(
        images[1], ax=panels[2:].tolist(), shrink=0.9, label="E, |I|, S [grey levels]", pad=0.01, extend="max"
    )
    return figure


@styled
def plot_grid_search(table: Sequence[JsonObject], chosen: JsonObject) -> Figure:
    """Plot the score of every candidate over its threshold T_s, one line per weight W_I.

    Args:
        table: rows with "threshold" [grey], "inhibition" and "score".
        chosen: the selected candidate, with "threshold".
    """
    figure = Figure(figsize=(WIDTH, 2.7))
    axes = figure.subplots()
    weights: dict[float, list[JsonObject]] = {}
    for row in sorted(table, key=lambda row: row["threshold"]):
        weights.setdefault(row["inhibition"], []).append(row)
    shades = colormaps["viridis"](np.linspace(0, 0.9, len(weights)))
    for shade, (weight, rows) in zip(shades, weights.items(), strict=True):
        thresholds, scores = zip(*((row["threshold"], row["score"]) for row in rows), strict=True)
        axes.plot(thresholds, scores, color=shade, marker="o", markersize=4, label=f"W_I = {weight:.3g}")
    axes.axvline(chosen["threshold"], color=RED, linewidth=1.2, linestyle="--", label="chosen T_s")
    axes.set(xlabel="threshold T_s [grey levels]", ylabel="correlation [1]")
    if min(row["threshold"] for row in table) > 0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
