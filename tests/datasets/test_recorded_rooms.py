"""Rooms of recorded walks: each walk in its own, and headers that describe none."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.datasets import pictures, recorded, recorded_rooms
from lgmdjax.errors import InputError
from lgmdjax.evaluation import trials
from lgmdjax.simulation import episodes, room_batches
from lgmdjax.world.arena import Arena

HERE = Path("walks")


def walk(room: int) -> episodes.Walk:
    fields = {name: getattr(synthetic.walk(1, 2), name)[0] for name in episodes.FIELDS}
    return episodes.Walk(**fields, episode=0, robot=0, room=room, seed=3)


def numbered_rooms(count: int) -> Arena:
    """Rooms whose start is at x = 0, 1, 2, ..."""
    starts = jnp.arange(float(count))[:, None] * jnp.asarray([1.0, 0, 0])
    arenas = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), synthetic.room())
    return arenas.replace(start=starts)


def starts(parameters: dict, rooms: list[int]) -> list[float]:
    found = recorded_rooms.find_rooms(parameters, [walk(room) for room in rooms], len(rooms), HERE)
    return [float(room.start[0]) for room in found]


def test_a_trial_has_more_rooms_than_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tube stands at thirty places for every seed."""
    monkeypatch.setattr(trials, "sample_rooms", lambda *_: SimpleNamespace(arena=numbered_rooms(60)))
    assert starts({"trial": "tube", "seeds": 2}, [0, 7, 59]) == [0, 7, 59]
    with pytest.raises(InputError, match="expected rooms 0 to 59, got room 60"):
        starts({"trial": "tube", "seeds": 2}, [60])


def test_walks_of_collect_count_their_rooms_through_all_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    batches = {0: numbered_rooms(2), 1: replace(numbered_rooms(2), start=numbered_rooms(2).start + 10)}
    monkeypatch.setattr(room_batches, "training_rooms", lambda _, batch, robots: SimpleNamespace(arena=batches[batch]))
    assert starts({"robots": 2}, [0, 1, 2, 3]) == [0, 1, 10, 11]


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"mine": 1}, "expected walks of a trial"),
        ({"trial": ["tube"], "seeds": 1}, "expected one of testing"),
        ({"trial": "tube", "seeds": 10**9}, "expected an integer of 1 to 10000"),
        ({"trial": "tube", "seeds": "3"}, "expected an integer"),
        ({"robots": 0}, "expected an integer of 1 to"),
        ({"robots": float("inf")}, "expected an integer"),
        ({"round": -1, "robots": 2}, "expected an integer of 0"),
        ({"benchmark": {"robots": 2}}, "expected an object with benchmark, contrast"),
        ({"benchmark": 7, "contrast": 1.0}, "expected an object with robots"),
    ],
)
def test_other_headers_are_one_line(parameters: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        recorded_rooms.find_rooms(parameters, [walk(0)], 1, HERE)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"eyes": {"width": 80}}, "an object with width, height"),
        ({"eyes": {"width": 80, "height": 60, "pooling": 61}}, "pooling: expected an integer of 1 to 60"),
        ({"eyes": {"width": 80, "height": 60, "overlap": 0.1}}, "overlap: expected a finite number of 0.5 to 1"),
        ({"lgmd": {"threshold": 0.25}}, "an object with threshold, suppression"),
        ({"lgmd": {"threshold": "0.25", "suppression": 1, "inhibition": 1}}, "threshold: expected a finite number"),
    ],
)
def test_another_camera_in_the_header_is_one_line(changed: dict, words: str) -> None:
    eyes, detector = {"width": 80, "height": 60}, {"threshold": 0.25, "suppression": 4.5, "inhibition": 0.4}
    header = {"parameters": {"eyes": eyes, "lgmd": detector} | changed}
    with pytest.raises(InputError, match=words):
        pictures.find_camera(recorded.Recording(folder=HERE, walks=[], header=header))
    right = recorded.Recording(folder=HERE, walks=[], header={"parameters": {"eyes": eyes, "lgmd": detector}})
    assert pictures.find_camera(right).settings.width == 80


def test_a_walk_that_has_a_room_is_read(tmp_path: Path) -> None:
    """The number of the room is written as it is read."""
    writer = episodes.Writer(tmp_path, {"robots": 2})
    writer.write(synthetic.walk(2, 5), episode=1, rooms=[2, 3], seed=0)
    np.testing.assert_array_equal([one.room for one in episodes.read(tmp_path)], [2, 3])
