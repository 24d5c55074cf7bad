"""The rhythm: tripods from anywhere, SciPy's numbers, the printed forms' failures."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import cpg as reference

from lgmdjax.errors import InputError
from lgmdjax.locomotion import cpg

RATE = 180  # steps a second, and a cycle
PARAMS = cpg.Params(cycle_time=1.0)


@partial(jax.jit, static_argnums=2)
def outputs(params, state, steps, interval=1 / RATE):
    """u_e - u_f of every unit over time."""
    return jax.lax.scan(lambda s, _: cpg.step(params, s, interval), state, length=steps)[1][:, :, 0]


@partial(jax.jit, static_argnums=2)
def last_state(params, state, steps, interval):
    return jax.lax.scan(lambda s, _: (cpg.step(params, s, interval)[0], None), state, length=steps)[0]


def flat(state):
    """As the reference orders it: u_e, u_f, v_e, v_f."""
    return np.concatenate([np.asarray(state.activation).T, np.asarray(state.adaptation).T])


@pytest.fixture(scope="module")
def from_random_starts():
    keys = jax.random.split(jax.random.key(0), 64)
    return np.asarray(jax.vmap(lambda key: outputs(PARAMS, cpg.init(PARAMS, key), 22 * RATE))(keys))


def test_every_random_start_becomes_a_tripod(from_random_starts):
    """Within 20 cycles all 64 are in antiphase to 1e-4 of a cycle; half of them to 1e-2 after 5."""
    tripods = np.array([0, 0.5, 0, 0.5, 0, 0.5])

    def error(cycles):
        phases = np.array([cpg.phases(x[: cycles * RATE], 1 / RATE, 1.0) for x in from_random_starts])
        return np.abs((phases - tripods + 0.5) % 1 - 0.5).max(1)

    assert error(22).max() < 1e-4
    assert np.median(error(6)) < 1e-2
    assert error(2).max() > 0.05  # they did start elsewhere


def test_random_starts_swing_as_far_as_the_settled_one(from_random_starts):
    settled = outputs(PARAMS, cpg.settled(PARAMS), RATE)
    amplitudes = np.abs(from_random_starts[:, -RATE:]).max(1)
    np.testing.assert_allclose(amplitudes, np.abs(settled).max(), rtol=1e-3)
    assert np.abs(settled).max() == pytest.approx(0.567, abs=1e-3)


def test_the_default_start_has_no_transient():
    x = np.asarray(outputs(PARAMS, cpg.init(PARAMS), 5 * RATE))
    np.testing.assert_allclose(x[:RATE], x[-RATE:], atol=3e-5)
    np.testing.assert_allclose(cpg.phases(x, 1 / RATE, 1.0), [0, 0.5, 0, 0.5, 0, 0.5], atol=1e-6)


def test_period_and_waveform_equal_scipy():
    params = PARAMS
    ours = np.asarray(outputs(params, cpg.settled(params), 10 * RATE))
    natural = reference.period(flat(cpg.settled(params)))
    assert natural == pytest.approx(cpg.NATURAL_PERIOD, rel=1e-6)
    assert cpg.period(ours[:, 0], 1 / RATE) == pytest.approx(1.0, rel=1e-5)
    times = np.arange(1, RATE + 1) / RATE * cpg.NATURAL_PERIOD
    theirs = reference.solve(flat(cpg.settled(params)), times)
    np.testing.assert_allclose(ours[:RATE], theirs[:, 0] - theirs[:, 1], atol=1e-5)


def test_transient_equals_scipy():
    params = PARAMS
    start = cpg.init(params, jax.random.key(3))
    ours = np.asarray(outputs(params, start, 2 * RATE))
    theirs = reference.solve(flat(start), np.arange(1, 2 * RATE + 1) / RATE * cpg.NATURAL_PERIOD)
    np.testing.assert_allclose(ours, theirs[:, 0] - theirs[:, 1], atol=5e-5)


def convergence(start, duration, steps):
    """Slope of log error against log step size, and the errors, over `duration` time units."""
    params = cpg.Params(substeps=1, cycle_time=cpg.NATURAL_PERIOD)
    exact = reference.solve(flat(start), np.array([duration]))[-1]
    errors = [np.abs(flat(last_state(params, start, n, duration / n)) - exact).max() for n in steps]
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0], errors


def test_fourth_order_where_no_neuron_crosses_zero():
    """One stretch of the limit cycle, 0.06 to 0.44 of it, in which every activation keeps its sign."""
    P = cpg.NATURAL_PERIOD
    point = reference.solve(flat(cpg.settled(PARAMS)), np.array([0.06 * P]))[-1]
    u, v = jnp.asarray(point[:2].T), jnp.asarray(point[2:].T)
    slope, _ = convergence(cpg.State(activation=u, adaptation=v), 0.38 * P, [16, 32, 64, 128])
    assert slope == pytest.approx(4.0, abs=0.2)


def test_second_order_over_cycles_because_the_rectifier_bends():
    steps = [100, 141, 200, 283, 400, 566, 800, 1131, 1600]
    slope, errors = convergence(cpg.settled(PARAMS), cpg.NATURAL_PERIOD, steps)
    assert 1.6 < slope < 2.9  # uneven: what counts is where in a step the crossings fall
    assert errors[-1] < 2e-6


def test_printed_sign_does_not_oscillate():
    params = replace(PARAMS, printed_sign=True)
    for seed in range(4):
        start = cpg.init(params, jax.random.key(seed))
        assert np.abs(outputs(params, start, 20 * RATE)[-RATE:]).max() < 1e-6


def test_printed_weights_never_make_a_tripod():
    """The legs of one tripod settle a third of a cycle apart, and the two tripods are told apart no more."""
    params = replace(PARAMS, coupling=cpg.coupling(within_tripod=0.40, across=0.04))
    np.testing.assert_allclose(params.coupling, reference.W_PRINTED)
    keys = jax.random.split(jax.random.key(1), 12)
    x = np.asarray(jax.vmap(lambda key: outputs(params, cpg.init(params, key), 60 * RATE))(keys))
    for walk in x:
        cycle = cpg.period(walk[-20 * RATE :, 0], 1 / RATE)
        phases = cpg.phases(walk, 1 / RATE, cycle)
        for tripod in (phases[0::2], phases[1::2]):
            gaps = np.diff(np.sort(tripod), append=np.sort(tripod)[0] + 1)
            np.testing.assert_allclose(gaps, 1 / 3, atol=0.02)


def test_amplitude_follows_the_drive_and_the_period_does_not():
    x = outputs(PARAMS, cpg.settled(PARAMS), 2 * RATE)
    doubled = replace(PARAMS, tonic=2.0)
    np.testing.assert_allclose(outputs(doubled, cpg.settled(doubled), 2 * RATE), 2 * x, atol=1e-12)


def test_cycle_time_is_in_seconds():
    for params, cycle in ((cpg.Params(), cpg.CYCLE_TIME), (cpg.Params(cycle_time=0.6), 0.6)):
        x = np.asarray(outputs(params, cpg.settled(params), 10 * RATE))
        assert cpg.period(x[:, 0], 1 / RATE) == pytest.approx(cycle, rel=2e-5)


def test_mirrored_legs_run_mirrored_half_a_cycle_later():
    x = np.asarray(outputs(PARAMS, cpg.settled(PARAMS), RATE))
    np.testing.assert_allclose(x[:-90, ::-1], x[90:], atol=1e-5)


def test_runs_in_either_precision(precision, strict):
    params = cpg.Params()
    state, rhythm = cpg.step(params, cpg.init(params, jax.random.key(0)), 1 / RATE)
    assert rhythm.dtype == state.activation.dtype == jnp.zeros(()).dtype == precision
    assert rhythm.shape == (6, 2)


def test_gradient_reaches_every_constant():
    def swing(params):
        return jnp.sum(outputs(params, cpg.settled(PARAMS), 90)[-1] ** 2)

    for name, slope in vars(jax.grad(swing)(PARAMS)).items():
        if name not in ("printed_sign", "substeps"):
            assert np.all(np.isfinite(slope)) and np.any(np.asarray(slope) != 0), name


def test_diagnostics_of_silence_are_not_numbers():
    assert np.isnan(cpg.period(np.zeros(100), 0.1))
    assert np.all(np.isnan(cpg.phases(np.zeros((100, 6)), 0.1, 1.0)))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"reaction_time": 0.0}, "reaction_time: expected a positive"),
        ({"cycle_time": float("nan")}, "cycle_time: expected a positive"),
        ({"tonic": -1.0}, "tonic: expected finite numbers >= 0"),
        ({"coupling": jnp.zeros((5, 5))}, r"expected shape \(6, 6\)"),
        ({"substeps": 0}, "substeps: expected 1 or more"),
    ],
)
def test_wrong_constants_are_named(wrong, said):
    cpg.check(cpg.Params())
    with pytest.raises(InputError, match=said):
        cpg.check(cpg.Params(**wrong))
