"""The part of a walk that is shown: turning and going on, few collisions, no reset."""

import numpy as np
import synthetic

from lgmdjax.reporting import selection

FRAMES = 600


def straight(speed: float = 0.002) -> np.ndarray:
    """Return the positions of a straight walk, in metres a frame."""
    return np.cumsum(np.full((FRAMES, 3), [speed, 0, 0]), axis=0)


def turning_in(*spans: tuple[int, int]) -> np.ndarray:
    """Return velocities of a robot that turns hard in some spans of frames."""
    velocity = np.full((FRAMES, 2), 1.2)
    for first, end in spans:
        velocity[first:end] = (2.0, -1.0)
    return velocity


def test_the_segment_with_most_turning_on_the_way_is_selected():
    position = straight()
    velocity = turning_in((60, 90), (180, 240), (400, 500))
    position[390:510] = position[390]  # here it turns on the spot
    assert selection.select_segment(position, velocity, 60)[0] in range(165, 196)


def test_resets_are_avoided():
    position, velocity = straight(), turning_in((60, 100), (180, 240))
    position[210:] += 3.0
    selected = selection.select_segment(position, velocity, 60)
    assert np.all(np.diff(selected) == 1)
    assert 60 in selected and 99 in selected
    assert selection.detect_resets(position).nonzero()[0].tolist() == [209]


def test_a_longer_segment_than_the_walk_is_the_walk():
    assert selection.select_segment(straight(), turning_in(), 10_000).tolist() == list(range(FRAMES))


def test_the_walk_that_turns_and_goes_on_is_selected():
    """The first has a collision, the second hardly turns, the fourth turns on the spot, the fifth is lost."""
    velocity = np.zeros((5, FRAMES, 2))
    velocity[..., 1] = np.array([3.0, 1.0, 2.0, 3.0, 3.0])[:, None]
    position = np.repeat(straight()[None], 5, axis=0)
    position[3] = 0.0
    contact, ok = np.zeros((5, FRAMES), bool), np.ones((5, FRAMES), bool)
    contact[0, 10], ok[4, 200:] = True, False
    record = synthetic.walk(5, FRAMES, position=position, velocity=velocity, contact=contact, ok=ok)
    assert selection.select_walk(record) == 2
