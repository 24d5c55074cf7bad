"""Figures and video of the report page, made from the files of a run folder."""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lgmdjax.body import robot_xml
from lgmdjax.evaluation import trials
from lgmdjax.locomotion.tripod_gait import Gait
from lgmdjax.reporting import walk_video
from lgmdjax.reporting.figures import comparison, detection, learning, locomotion, trajectories
from lgmdjax.runtime.storage import JsonObject, read_arrays
from lgmdjax.sensors import camera
from lgmdjax.world import arena

NOMINAL_SPEED = float(Gait().nominal_velocity)  # m/s, at v = 1
TITLES = {name: trial.title for name, trial in trials.TRIALS.items()}
VARIANTS = {
    "lstm": "LSTM",
    "lstm-halves": "LSTM, teacher's walks in halves (as in the paper)",
    "lstm-efference": "LSTM, with the last command",
    "feed-forward": "feed-forward",
    "mean": "mean command",
}
Arrays = Mapping[str, np.ndarray]


def plot_gait(run_folder: Path, gait: JsonObject, onset: Arrays) -> dict[str, Figure]:
    """Plot the CPG's onset, the path of a foot, and the walked speeds."""
    foot = read_arrays(run_folder / "fit-gait/foot.npz")
    period, cycles = float(onset["period"]), float(onset["transient_cycles"])
    return {
        "cpg": locomotion.plot_cpg_outputs(onset["time"], onset["rhythm"], period, cycles),
        "foot": locomotion.plot_foot_paths(foot["velocities"], foot["commanded"], foot["simulated"], foot["literal"]),
        "sweep": locomotion.plot_gait_sweep(gait["sweep"], gait["literal"], NOMINAL_SPEED),
    }


def plot_detection(run_folder: Path, calibration: JsonObject) -> dict[str, Figure]:
    """Plot one picture with the layers of the LGMD, and the grid search of its threshold."""
    layers = read_arrays(run_folder / "evaluate/layers.npz")
    return {
        "layers": detection.plot_lgmd_layers(layers["picture"], layers["E"], layers["I"], layers["S"]),
        "calibration": detection.plot_grid_search(calibration["table"], calibration),
    }


def plot_learning(run_folder: Path, training: JsonObject) -> dict[str, Figure]:
    """Plot the learning curves, and predicted commands in a held-out room."""
    prediction = read_arrays(run_folder / "train/prediction.npz")
    distances = "corridor" if "corridor" in prediction else "distances"  # the latter in runs of versions before 0.3
    series = (prediction[name] for name in ("time", "u", distances, "label", "predicted"))
    return {
        "losses": learning.plot_losses(training["curves"], VARIANTS),
        "prediction": learning.plot_predictions(*series),
    }


def plot_walks(run_folder: Path, scores: Mapping[str, JsonObject], room: arena.Arena) -> dict[str, Figure]:
    """Plot the paths of all policies in the testing room, their collision rates, and these against coverage.

    Args:
        run_folder: with trajectories.npz of stage evaluate.
        scores: by trial and policy, of the trials that continue after a collision.
        room: the testing room.
    """
    arrays = read_arrays(run_folder / "evaluate/trajectories.npz")
    paths = {}
    for policy in scores["testing"]:
        name = f"testing_{policy}"
        resets = arrays.get(f"{name}_resets", arrays.get(f"{name}_setbacks"))  # of version 0.1.0
        if resets is None:
            raise KeyError(f"{name}_resets")
        paths[policy] = trajectories.Paths(arrays[name], resets, arrays[f"{name}_contact"])
    rates = {TITLES[trial]: by_policy for trial, by_policy in scores.items()}
    return {
        "trajectories": trajectories.plot_trajectories(room, paths),
        "policies": comparison.plot_collision_rates(rates),
        "coverage": comparison.plot_collisions_against_coverage(rates),
    }


def render_video(run_folder: Path, camera_params: camera.Params, room: arena.Arena, seconds: float) -> bytes:
    """Render the video of the learned policy's walk, and return it as MP4."""
    recorded = read_arrays(run_folder / "evaluate/walk.npz")
    trace = walk_video.WalkTrace(*(recorded[name] for name in walk_video.WalkTrace._fields))
    buffer, body = io.BytesIO(), robot_xml.read_body(run_folder / "fit-gait")
    walk_video.write_trace(buffer, trace, room, camera_params, seconds, body=body)
    return buffer.getvalue()
