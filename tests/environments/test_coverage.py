"""New floor: what is entered and what is covered, against the metric of recorded walks and by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic

from lgmdjax.environments import coverage
from lgmdjax.evaluation import metrics

CELL = metrics.CELL


@jax.jit
def follow(path):
    """What is new in each frame of a path, after its first point."""
    return jax.lax.scan(coverage.step, coverage.init(path[0]), path[1:])[1]


def line(first, last, points=401):
    return jnp.asarray(np.linspace(first, last, points))


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.1])
def test_cells_entered_are_those_that_the_metric_counts(turn):
    """Of a path without sway, in a curve through four quadrants; the first cell is not new."""
    angle = np.linspace(0.0, 5.0, 400)
    path = np.stack([1.3 * np.cos(angle + turn), 0.9 * np.sin(angle)], axis=-1)
    record = synthetic.walk(1, 400)
    record = replace(record, position=np.concatenate([path, np.zeros((400, 1))], axis=-1)[None])
    entered, _ = follow(jnp.asarray(path))
    assert float(entered.sum()) == metrics.count_cells(record, 1 / 30)[0] - 1 > 20


@pytest.mark.parametrize("offset", [0.0, 0.07, 0.125])
def test_a_straight_walk_covers_a_cell_every_quarter_of_a_metre(offset):
    _, covered = follow(line([0.125, offset], [2.125, offset]))
    np.testing.assert_allclose(covered.sum(), 2.0 / CELL, rtol=1e-6)


def test_nothing_is_new_on_the_way_back():
    path = line([0.125, 0.0], [1.125, 0.0])
    entered, covered = follow(jnp.concatenate([path, path[::-1]]))
    assert entered[400:].sum() == 0
    np.testing.assert_allclose(covered[400:], 0.0, atol=1e-12)


def test_derivative_of_the_floor_covered_is_that_of_central_differences():
    state = coverage.init(jnp.asarray([0.1, 0.03]))
    new = lambda position: coverage.step(state, position)[1][1]  # noqa: E731
    here, step = jnp.asarray([0.2, 0.09]), 1e-6
    expected = [(new(here + step * e) - new(here - step * e)) / (2 * step) for e in jnp.eye(2)]
    np.testing.assert_allclose(jax.grad(new)(here), expected, rtol=1e-6)
    assert np.all(np.abs(expected) > 0.1)
