"""The robot's body and the geometry of its legs."""

import pytest

from lgmdjax.body import hexapod
from lgmdjax.locomotion import kinematics


@pytest.fixture(scope="session")
def body():
    return hexapod.load()


@pytest.fixture(scope="session")
def geometry(body):
    return kinematics.read_geometry(body)
