"""The CPG: convergence to the tripod rhythm, agreement with SciPy, failure of the printed forms."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import cpg as reference

from lgmdjax.errors import InputError
from lgmdjax.locomotion import cpg

RATE = 180  # steps per second and per cycle
PARAMS = cpg.Params(cycle_time=1.0)


@partial(jax.jit, static_argnums=2)
def outputs(params, state, steps, interval=1 / RATE):
    """Return u_e - u_f of every unit over time."""
    return jax.lax.scan(lambda s, _: cpg.step(params, s, interval), state, length=steps)[1][:, :, 0]


@partial(jax.jit, static_argnums=2)
def last_state(params, state, steps, interval):
    return jax.lax.scan(lambda s, _: (cpg.step(params, s, interval)[0], None), state, length=steps)[0]


def flat(state):
    """Return the state in the order of the reference: u_e, u_f, v_e, v_f."""
    return np.concatenate([np.asarray(state.activation).T, np.asarray(state.adaptation).T])


@pytest.fixture(scope="module")
def from_random_starts():
    keys = jax.random.split(jax.random.key(0), 64)
    return np.asarray(jax.vmap(lambda key: outputs(PARAMS, cpg.init(PARAMS, key), 22 * RATE))(keys))


def test_every_random_start_converges_to_a_tripod(from_random_starts):
    """After 22 cycles all 64 are in antiphase to 1e-4 of a cycle; half of them to 1e-2 after 6."""
    tripods = np.array([0, 0.5, 0, 0.5, 0, 0.5])

    def error(cycles):
        phases = np.array([cpg.phases(x[: cycles * RATE], 1 / RATE, 1.0) for x in from_random_starts])
        return np.abs((phases - tripods + 0.5) % 1 - 0.5).max(1)

    assert error(22).max() < 1e-4
    assert np.median(error(6)) < 1e-2
    assert error(2).max() > 0.05  # the starts differ


def test_random_starts_reach_the_amplitude_of_the_limit_cycle(from_random_starts):
    settled = outputs(PARAMS, cpg.limit_cycle_state(PARAMS), RATE)
    amplitudes = np.abs(from_random_starts[:, -RATE:]).max(1)
    np.testing.assert_allclose(amplitudes, np.abs(settled).max(), rtol=1e-3)
    assert np.abs(settled).max() == pytest.approx(0.567, abs=1e-3)


def test_the_default_start_has_no_transient():
    x = np.asarray(outputs(PARAMS, cpg.init(PARAMS), 5 * RATE))
    np.testing.assert_allclose(x[:RATE], x[-RATE:], atol=3e-5)
    np.testing.assert_allclose(cpg.phases(x, 1 / RATE, 1.0), [0, 0.5, 0, 0.5, 0, 0.5], atol=1e-6)


def test_period_and_waveform_equal_scipy():
    params = PARAMS
    ours = np.asarray(outputs(params, cpg.limit_cycle_state(params), 10 * RATE))
    natural = reference.period(flat(cpg.limit_cycle_state(params)))
    assert natural == pytest.approx(cpg.NATURAL_PERIOD, rel=1e-6)
    assert cpg.period(ours[:, 0], 1 / RATE) == pytest.approx(1.0, rel=1e-5)
    times = np.arange(1, RATE + 1) / RATE * cpg.NATURAL_PERIOD
    theirs = reference.solve(flat(cpg.limit_cycle_state(params)), times)
    np.testing.assert_allclose(ours[:RATE], theirs[:, 0] - theirs[:, 1], atol=1e-5)


def test_transient_equals_scipy():
    params = PARAMS
    start = cpg.init(params, jax.random.key(3))
    ours = np.asarray(outputs(params, start, 2 * RATE))
    theirs = reference.solve(flat(start), np.arange(1, 2 * RATE + 1) / RATE * cpg.NATURAL_PERIOD)
    np.testing.assert_allclose(ours, theirs[:, 0] - theirs[:, 1], atol=5e-5)


def convergence(start, duration, steps):
    """Return the order of convergence and the errors after `duration` time units."""
    params = cpg.Params(substeps=1, cycle_time=cpg.NATURAL_PERIOD)
    exact = reference.solve(flat(start), np.array([duration]))[-1]
    errors = [np.abs(flat(last_state(params, start, n, duration / n)) - exact).max() for n in steps]
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0], errors


def test_fourth_order_where_no_neuron_crosses_zero():
    """On a segment of the limit cycle, 0.06 to 0.44, in which every activation keeps its sign."""
    P = cpg.NATURAL_PERIOD
    point = reference.solve(flat(cpg.limit_cycle_state(PARAMS)), np.array([0.06 * P]))[-1]
    u, v = jnp.asarray(point[:2].T), jnp.asarray(point[2:].T)
    order, _ = convergence(cpg.State(activation=u, adaptation=v), 0.38 * P, [16, 32, 64, 128])
    assert order == pytest.approx(4.0, abs=0.2)


def test_second_order_over_cycles_because_of_the_rectifier():
    steps = [100, 141, 200, 283, 400, 566, 800, 1131, 1600]
    order, errors = convergence(cpg.limit_cycle_state(PARAMS), cpg.NATURAL_PERIOD, steps)
    assert 1.6 < order < 2.9  # it varies with the position of the zero crossings within a step
    assert errors[-1] < 2e-6


def test_printed_sign_does_not_oscillate():
    params = replace(PARAMS, printed_sign=True)
    for seed in range(4):
        start = cpg.init(params, jax.random.key(seed))
        assert np.abs(outputs(params, start, 20 * RATE)[-RATE:]).max() < 1e-6


def test_printed_weights_never_make_a_tripod():
    """The legs of one tripod settle a third of a cycle apart, so that there is no tripod gait."""
    params = replace(PARAMS, coupling=cpg.coupling(within_tripod=0.40, across=0.04))
    np.testing.assert_allclose(params.coupling, reference.W_PRINTED)
    keys = jax.random.split(jax.random.key(1), 12)
    x = np.asarray(jax.vmap(lambda key: outputs(params, cpg.init(params, key), 60 * RATE))(keys))
    for output in x:
        cycle_time = cpg.period(output[-20 * RATE :, 0], 1 / RATE)
        phases = cpg.phases(output, 1 / RATE, cycle_time)
        for tripod in (phases[0::2], phases[1::2]):
            gaps = np.diff(np.sort(tripod), append=np.sort(tripod)[0] + 1)
            np.testing.assert_allclose(gaps, 1 / 3, atol=0.02)


def test_amplitude_is_proportional_to_the_drive_and_the_period_is_not():
    x = outputs(PARAMS, cpg.limit_cycle_state(PARAMS), 2 * RATE)
    doubled = replace(PARAMS, tonic=2.0)
    np.testing.assert_allclose(outputs(doubled, cpg.limit_cycle_state(doubled), 2 * RATE), 2 * x, atol=1e-12)


def test_cycle_time_is_in_seconds():
    for params, cycle in ((cpg.Params(), cpg.CYCLE_TIME), (cpg.Params(cycle_time=0.6), 0.6)):
        x = np.asarray(outputs(params, cpg.limit_cycle_state(params), 10 * RATE))
        assert cpg.period(x[:, 0], 1 / RATE) == pytest.approx(cycle, rel=2e-5)


def test_mirrored_legs_are_half_a_cycle_late():
    x = np.asarray(outputs(PARAMS, cpg.limit_cycle_state(PARAMS), RATE))
    np.testing.assert_allclose(x[:-90, ::-1], x[90:], atol=1e-5)


def test_runs_in_either_precision(precision, strict):
    params = cpg.Params()
    state, rhythm = cpg.step(params, cpg.init(params, jax.random.key(0)), 1 / RATE)
    assert rhythm.dtype == state.activation.dtype == jnp.zeros(()).dtype == precision
    assert rhythm.shape == (6, 2)


def test_gradient_reaches_every_constant():
    def energy(params):
        return jnp.sum(outputs(params, cpg.limit_cycle_state(PARAMS), 90)[-1] ** 2)

    for name, gradient in vars(jax.grad(energy)(PARAMS)).items():
        if name not in ("printed_sign", "substeps"):
            assert np.all(np.isfinite(gradient)) and np.any(np.asarray(gradient) != 0), name


def test_period_and_phases_are_nan_without_oscillation():
    assert np.isnan(cpg.period(np.zeros(100), 0.1))
    assert np.all(np.isnan(cpg.phases(np.zeros((100, 6)), 0.1, 1.0)))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"reaction_time": 0.0}, "reaction_time: expected a positive"),
        ({"cycle_time": float("nan")}, "cycle_time: expected a positive"),
        ({"tonic": -1.0}, "tonic: expected finite numbers >= 0"),
        ({"coupling": jnp.zeros((5, 5))}, r"expected shape \(6, 6\)"),
        ({"substeps": 0}, "substeps: expected 1 or more"),
    ],
)
def test_impossible_parameters_are_refused(wrong, message):
    cpg.check(cpg.Params())
    with pytest.raises(InputError, match=message):
        cpg.check(cpg.Params(**wrong))
