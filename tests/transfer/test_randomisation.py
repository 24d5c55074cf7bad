"""Rooms whose robots have faulty cameras: which faults they get, and that the same key gives the same."""

import jax
import numpy as np
import pytest

import lgmdjax as lj
from lgmdjax.errors import InputError
from lgmdjax.simulation import room_batches
from lgmdjax.transfer import faults, randomisation

NAMES = ("noise", "jpeg", "latency")


@pytest.fixture(scope="module")
def rooms():
    return lj.random_rooms(jax.random.key(0), 200)


def test_each_robot_has_each_fault_with_the_given_probability(rooms):
    drawn = randomisation.randomise_cameras(rooms, NAMES, 0.3).faults
    assert drawn is not None
    has = np.stack([np.asarray(drawn.noise) > 0, np.asarray(drawn.quality) > 0, np.asarray(drawn.latency) > 0])
    assert np.all(np.abs(has.mean(axis=1) - 0.3) < 0.11)  # three standard deviations
    assert np.all(np.abs(np.corrcoef(has) - np.eye(3)) < 0.22)  # one fault says nothing about another
    assert np.all(np.asarray(drawn.blur) == 0) and np.asarray(drawn.latency).dtype == np.int32


def test_a_certain_fault_is_the_one_that_its_key_draws(rooms):
    drawn = randomisation.randomise_cameras(rooms, ("exposure", "latency")).faults
    assert drawn is not None
    for k in (0, 77):
        own = faults.draw(jax.random.fold_in(rooms.key[k], 1), "exposure", "latency").camera
        gamma, latency = (float(np.asarray(leaf)[k]) for leaf in (drawn.gamma, drawn.latency))
        assert (gamma, latency) == pytest.approx((float(own.gamma), int(own.latency)))


def test_rooms_stay_as_they_are(rooms):
    assert randomisation.randomise_cameras(rooms, ()) is rooms
    own, other = randomisation.training_rooms(3, 1, 4), randomisation.training_rooms(3, 1, 4, ("noise",))
    plain = room_batches.training_rooms(3, 1, 4)
    jax.tree.map(np.testing.assert_array_equal, own.arena, plain.arena)
    jax.tree.map(np.testing.assert_array_equal, other.arena, plain.arena)
    assert own.faults is None and other.faults is not None


def test_vignetting_is_refused(rooms):
    with pytest.raises(InputError, match="expected no vignetting in the closed loop"):
        randomisation.randomise_cameras(rooms, ("vignetting",))
