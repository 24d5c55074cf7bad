"""Synthetic walks, and a synthetic run folder as the stages write it, with plausible numbers."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lgmdjax.control.names import POLICY_NAMES
from lgmdjax.evaluation import metrics
from lgmdjax.evaluation.collision_causes import CAUSES
from lgmdjax.simulation.closed_loop import FRAME_RATE, Record
from lgmdjax.world import arena

COLLISIONS_PER_100_M = {"teacher": 0.4, "learned": 3.21, "blind": 17.3, "direct": 12.9, "random": 19.8}
CYCLE_TIME = 1.0  # s


def room() -> arena.Arena:
    """A small room with three boxes, one of them overhead, and two cylinders."""
    return arena.empty_room(
        (8.0, 8.0),
        boxes=arena.make_prisms(
            [[2.0, 1.0], [-1.5, -2.0], [0.5, -1.5]],
            [[0.3, 0.5], [0.4, 0.4], [0.8, 0.3]],
            [0.8, 0.6, 0.9],
            yaw=[0.4, 0.0, 0.2],
            bottom=[0.0, 0.0, 0.7],
            texture=[[150.0, 0.7, 0.3, 0.4], [90.0, 0.6, 1.0, 0.5], [120.0, 0.5, 2.0, 0.6]],
        ),
        cylinders=arena.make_prisms(
            [[-2.0, 1.5], [1.0, -2.8]], [[0.2, 0.2], [0.15, 0.15]], [1.0, 1.4], texture=(60.0, 0.8, 0.5, 0.3)
        ),
        start=(0.0, 2.5, 0.0),
    )


def walk(robots: int = 2, frames: int = 1200, **changes: np.ndarray) -> Record:
    """A record of robots that walk straight at 0.05 m/s, with a lateral sway of 2 cm in a gait cycle of a second."""
    time = np.arange(frames) / FRAME_RATE
    position = np.zeros((robots, frames, 3))
    position[..., 0] = 0.05 * time
    position[..., 1] = 0.02 * np.sin(2 * np.pi * time)
    fields = {
        "time": np.broadcast_to(time, (robots, frames)),
        "position": position,
        "quaternion": np.broadcast_to([1.0, 0, 0, 0], (robots, frames, 4)),
        "joints": np.zeros((robots, frames, 6, 3)),
        **{name: np.zeros((robots, frames, 2)) for name in ("u", "feed_forward", "excitation")},
        **{name: np.zeros((robots, frames, 2)) for name in ("distances", "corridor", "label", "velocity")},
        "clearance": np.full((robots, frames), 0.3),
        "contact": np.zeros((robots, frames), bool),
        "is_first": np.zeros((robots, frames), bool),
        "resets": np.zeros((robots, frames), int),
        "ok": np.ones((robots, frames), bool),
    }
    return Record(**(fields | changes))


def walks(generator: np.random.Generator, robots: int, frames: int) -> dict[str, np.ndarray]:
    """Random paths at 0.06 m/s from (0, 2.5); robot 0 has a contact halfway and is reset."""
    turning = np.cumsum(generator.normal(0, 0.02, (robots, frames)), axis=1)
    yaw = np.cumsum(0.3 * np.tanh(turning) / FRAME_RATE, axis=1)
    steps = 0.06 / FRAME_RATE * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=-1)
    positions = np.array([0.0, 2.5, 0.1]) + np.cumsum(steps, axis=1)
    half = frames // 2
    resets, contact = np.zeros((robots, frames), int), np.zeros((robots, frames), bool)
    resets[0, half:], contact[0, half - 1] = 1, True
    positions[0, half:] += np.array([-1.0, -3.0, 0.0])
    return {"": positions, "_resets": resets, "_contact": contact}


def score(rate: float) -> dict:
    """The JSON of `metrics.score`."""

    def estimate(value: float) -> dict[str, float]:
        return {"value": value, "low": 0.7 * value, "high": 1.4 * value}

    return {
        "robots": 5,
        "lost": 0,
        "distance": 235.3,
        "collisions": round(rate * 2.353),
        "per_100_m": estimate(rate),
        "first_collision": estimate(100 / (rate + 0.1)),
        "clearance": estimate(0.31),
        "speed": 0.0587,
        "turning": 0.113,
        "progress": progress(),
    }


def progress() -> dict:
    """The JSON of `metrics.progress`."""
    return {
        "coverage": {"value": 18.2, "low": 17.1, "high": 19.4},
        "hard_turning": {"value": 0.12, "low": 0.1, "high": 0.14},
        "net_rotation": {"value": 0.7, "low": 0.6, "high": 0.8},
        "longest_rotation": 1.3,
    }


def rows_of(study: str) -> list[dict]:
    """Rows that a study writes."""
    rate = {"per_100_m": asdict(metrics.poisson_rate(2, 0.9)), "distance": 90.0, "collisions": 2}
    if study == "velocity":
        row = {"obstructed": 0.6, "free": 0.55, "spread": 0.02}
        return [
            row | {"velocity": v, "effect": v, "as_good": v > 1, "low": v - 0.1, "high": v + 0.1, "speed": 0.05 * v}
            for v in (0.1, 1.0, 5.0)
        ]
    if study == "supervision":
        learners = [{"policy": "learned", "rule": "2a", "variant": "lstm", "repeat": k} | rate for k in range(3)]
        return [{"policy": "teacher", "rule": "2a"} | rate, {"policy": "direct", "rule": "teacher"} | rate, *learners]
    if study == "errata":
        stuck = {"per_100_m": asdict(metrics.poisson_rate(0, 0.001)), "distance": 0.1, "collisions": 0}
        row = {"case": "eq. 15", "speed": 0.05, "u": {"score": 0.7, "left": 0.5, "right": 0.6}}
        return [row | {"teacher": rate, "learned": rate}, row | {"case": "eq. 1", "teacher": stuck, "learned": stuck}]
    if study == "failure_modes":
        away = {
            "avoided": asdict(metrics.wilson_proportion(9, 12)),
            "untouched": 9,
            "robots": 12,
            "passed": 6,
            "passing": asdict(metrics.wilson_proportion(6, 12)),
            "retreated": 2,
        }
        walls = [{"trial": "white", "contrast": c, "policy": "learned"} | away for c in (0.0, 0.5)]
        others = [{"trial": "white", "contrast": 0.0, "policy": "teacher"} | away]
        corners = [{"trial": "corner", "contrast": None, "policy": name} | away for name in ("learned", "eq. 22")]
        return walls + others + corners
    if study == "gait_gradient":
        walked = {
            "velocities": [1.0, 2.0],
            "speed_errors": [1e-3, 2e-3],
            "pitch_deg": [0.1, 0.2],
            "roll_deg": [0.1, 0.1],
        }
        fits = [
            {"method": m, "repeat": 0, "curve": [[28.8, 0.6], [57.6, 0.4]]} | walked for m in ("gradient", "evolution")
        ]
        return [{"method": "initial", "repeat": 0, "curve": []} | walked, *fits]
    if study == "overlap":
        return [{"overlap": x, "episodes": [0.8 * x, 0.7 * x], "tube": 1.0 - 0.2 * x} for x in (0.5, 0.7, 1.0)]
    if study == "gradient_horizon":
        return [
            {"contact": contact, "precision": precision, "robot": robot, "horizon": horizon, "norm": 0.1 * horizon}
            | {"reverse": 1.0, "forward": 1.0 + 1e-12, "difference": 1.0 + 1e-8}
            for contact in ("hard", "soft")
            for precision in ("float64", "float32")
            for robot in range(2)
            for horizon in (1, 15)
        ]
    row = rate | {"speed": 0.05}
    changed = [{"parameter": "T_s", "value": v, "is_baseline": v == 1.0} | row for v in (0.5, 1.0)]
    learner = {"parameter": "minutes", "value": 15.0, "is_baseline": False}
    return changed + [learner | {"repeat": k} | row for k in range(2)]


def write_experiments(run: Path) -> Path:
    """Add what only `--scale paper` has to a run folder: a trial that ends, and the studies."""
    facts = json.loads((run / "run.json").read_text())
    facts["settings"]["evaluate"]["trials"].append({"trial": "tube", "eyes": {"width": 320, "height": 240}})
    for study in ("velocity", "supervision", "errata", "failure_modes", "sensitivity"):
        facts["settings"][study] = {"benchmark": {"robots": 16, "eyes": {"width": 80, "height": 60}}}
        (run / study).mkdir()
        (run / study / "done.json").write_bytes((run / "train" / "done.json").read_bytes())
        _json(run / study / f"{study}.json", rows_of(study))
    _json(run / "run.json", facts)
    evaluation = json.loads((run / "evaluate" / "evaluation.json").read_text())
    outcome = {
        "robots": 30,
        "untouched": 29,
        "passed": 25,
        "retreated": 4,
        "clearance": [0.1] * 30,
        "seconds": [20.0] * 30,
    }
    outcome["avoided"] = asdict(metrics.wilson_proportion(29, 30))
    outcome["passing"] = asdict(metrics.wilson_proportion(25, 30))
    outcome["made_good"] = {"value": 0.04, "low": 0.03, "high": 0.05}
    outcome["progress"] = progress()
    evaluation["tube"] = dict.fromkeys(("teacher", "learned", "blind"), outcome)
    _json(run / "evaluate" / "evaluation.json", evaluation)
    (run / "evaluate" / "tube.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    return run


def write_run(folder: Path, *, frames: int = 1800, pixels: tuple[int, int] = (240, 320)) -> Path:
    """Write every file that the report reads, and return the folder."""
    generator = np.random.default_rng(7)
    versions = {"python": "3.11.9", "lgmdjax": "0.1.0", "jax": "0.9.2", "mujoco": "3.17.0"}
    for name in ("fit-gait", "collect", "train", "evaluate"):
        (folder / name).mkdir(parents=True)
        _json(folder / name / "done.json", {"seconds": 12.5, "device": "cpu, 2 cores", "versions": versions})
    settings = {
        "fit-gait": {"steps": 3000, "seconds": 25},
        "evaluate": {"trials": [{"trial": "testing", "eyes": {"width": 80, "height": 60}}]},
        "train": {"epochs": 40, "dagger_rounds": 2},
    }
    _json(
        folder / "run.json",
        {"format": 1, "scale": "quick", "seed": 4711, "settings": settings, "versions": versions},
    )
    _write_gait(folder / "fit-gait", generator)
    _write_collect(folder / "collect", generator)
    _write_train(folder / "train", generator)
    _write_evaluate(folder / "evaluate", generator, frames, pixels)
    return folder


def _json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content))


def _write_gait(folder: Path, generator: np.random.Generator) -> None:
    time = np.arange(0, 8, 1 / 180)
    settled = 1 - np.exp(-time / 1.2)
    phase = 2 * np.pi * time / CYCLE_TIME
    start = generator.uniform(0, 2 * np.pi, 6)
    rhythm = [0.57 * np.sin(phase + np.pi * (leg % 2) + start[leg] * (1 - settled)) * settled for leg in range(6)]
    np.savez(folder / "cpg.npz", time=time, rhythm=np.stack(rhythm, 1), transient_cycles=3.1, period=CYCLE_TIME)
    loop = np.linspace(0, 2 * np.pi, 180)
    v = np.array([0.5, 1.0, 2.0])
    commanded = np.stack(
        [
            0.2 + 0.0125 * v[:, None] * np.cos(loop),
            np.full((3, 180), 0.16),
            -0.10 + 0.03 * np.maximum(np.sin(loop), 0) + 0 * v[:, None],
        ],
        -1,
    )
    literal = np.stack([0.2 + 0.02 * np.cos(loop), np.full(180, 0.16), -0.10 + 0.01 * (1 + np.cos(loop))], -1)
    np.savez(
        folder / "foot.npz",
        velocities=v,
        commanded=commanded,
        literal=literal,
        simulated=commanded + generator.normal(0, 3e-4, commanded.shape),
    )
    sweep = []
    for left, right in ((-1, -1), (0.5, 0.5), (1, 1), (1.2, 1.2), (2, 2), (-1, 1), (1, -1), (0.5, 1.5)):
        speed, turn = 0.025 * (left + right), 0.065 * (right - left)
        sweep.append(
            {
                "velocity": [left, right],
                "asked": speed,
                "mjx": 0.98 * speed,
                "c": 0.975 * speed,
                "yaw_rate_mjx": turn,
                "yaw_rate_c": 1.01 * turn,
                "drift_deg": 1.7,
            }
        )
    _json(
        folder / "gait.json",
        {
            "cycle_time": CYCLE_TIME,
            "sweep": sweep,
            "literal": {"mjx": 0.0071, "c": 0.0069},
            "sway": {"pitch_deg": 0.8, "roll_deg": 1.1, "yaw_deg": 0.9, "bounce_mm": 1.4},
        },
    )


def _write_collect(folder: Path, generator: np.random.Generator) -> None:
    table = [
        {
            "threshold": t,
            "inhibition": w,
            "left": 0.6,
            "right": 0.5,
            "score": 0.7 - 0.02 * (t - 6 * w - 3) ** 2,
        }
        for w in (0.3, 0.4)
        for t in (1.0, 2.0, 4.0, 6.0, 8.0)
    ]
    best = max(table, key=lambda row: row["score"])
    _json(folder / "calibration.json", {**best, "suppression": 20.0, "overlap": 0.6, "table": table})
    np.savez(folder / "rooms.npz", positions=walks(generator, 4, 900)[""][..., :2])


def _write_train(folder: Path, generator: np.random.Generator) -> None:
    epochs = np.arange(40)
    curves, table = {}, []
    for name, floor in (("lstm", 0.20), ("lstm-efference", 0.15), ("feed-forward", 0.42)):
        train = floor + np.exp(-epochs / 8) * np.exp(generator.normal(0, 0.03, 40))
        curves[name] = {"train": train.tolist(), "test": (train * 1.2 + 0.02).tolist()}
        table.append(
            {
                "variant": name,
                "train_mse": train[-1],
                "test_mse": curves[name]["test"][-1],
                "unseen_mse": 1.3 * train[-1],
                "test_r2": [0.61, 0.58],
                "test_steering": 0.77,
                "unseen_steering": 0.71,
                "unseen_r2": [0.52, 0.49],
            }
        )
    table.append(
        {
            "variant": "mean",
            "train_mse": 1.0,
            "test_mse": 1.1,
            "unseen_mse": 1.2,
            "test_r2": [0.0, -0.01],
            "test_steering": 0.0,
            "unseen_steering": 0.0,
            "unseen_r2": [-0.02, -0.03],
        }
    )
    _json(
        folder / "training.json",
        {"curves": curves, "table": table, "minutes": {"train": 25.5, "test": 25.4, "unseen": 9.1}},
    )
    time = np.arange(900) / FRAME_RATE
    distances = np.clip(np.stack([2.2 + 2 * np.sin(time / 4), 2.2 + 2 * np.cos(time / 5)], 1), 0.3, 5)
    label = np.clip(1.2 + 0.8 / distances - 0.6 / distances[:, ::-1], -1, 2)
    np.savez(
        folder / "prediction.npz",
        time=time,
        corridor=distances,
        label=label,
        u=0.5 + 0.3 / distances / 2 + np.abs(generator.normal(0, 0.02, (900, 2))),
        predicted=label + generator.normal(0, 0.08, label.shape),
    )


def _write_evaluate(folder: Path, generator: np.random.Generator, frames: int, pixels: tuple[int, int]) -> None:
    scores = {name: score(rate) for name, rate in COLLISIONS_PER_100_M.items()}
    _json(
        folder / "evaluation.json",
        {"testing": scores, "unseen": {name: score(1.1 * r) for name, r in COLLISIONS_PER_100_M.items()}},
    )
    kinds = {"corner": 0, "did not see": 1, "saw both sides": 0, "tail swing": 2, "turned the other way": 0}
    _json(folder / "kinds.json", {"testing": kinds | {"turned too late": 5}, "unseen": dict.fromkeys(CAUSES, 0)})
    paths = {
        f"testing_{name}{key}": value for name in POLICY_NAMES for key, value in walks(generator, 5, frames).items()
    }
    unseen = {f"unseen_learned{key}": value for key, value in walks(generator, 4, frames).items()}
    np.savez(folder / "trajectories.npz", allow_pickle=False, **paths, **unseen)
    rows, columns = np.mgrid[: pixels[0], : pixels[1]]
    picture = 127 + 90 * np.sin(columns / 11) * np.sin(rows / 17)
    change = np.abs(90 * np.cos(columns / 11) * np.sin(rows / 17)) * (columns > pixels[1] // 2) / 6
    np.savez(folder / "layers.npz", picture=picture, E=change, I=2 * change, S=change - 0.8 * np.roll(change, 2, 1))
    path = walks(generator, 1, frames)[""][0] + np.array([0, -1.5, 0])
    heading = np.arctan2(*np.gradient(path[:, 1::-1], axis=0).T)
    time = np.arange(frames) / FRAME_RATE
    stance = np.tile([[0.0, 0.65, -0.38]], (6, 1))
    swing = 0.2 * np.sin(2 * np.pi * time[:, None] + np.pi * (np.arange(6) % 2))
    joints = stance + swing[..., None] * np.array([1.0, 0.5, 0.0])
    distances = np.clip(np.stack([2.2 + 2 * np.sin(time / 4), 2.2 + 2 * np.cos(time / 5)], 1), 0.3, 5)
    np.savez(
        folder / "walk.npz",
        time=time,
        position=path,
        joints=joints,
        distances=distances,
        quaternion=np.stack([np.cos(heading / 2), 0 * heading, 0 * heading, np.sin(heading / 2)], -1),
        u=0.5 + 0.15 / distances,
        velocity=1.2 + 0.8 / distances - 0.6 / distances[:, ::-1],
        contact=np.zeros(frames, bool),
    )
