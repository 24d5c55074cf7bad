"""The Matsuoka network of sec. 3.2 in NumPy, transcribed from eqs. 1-6 and solved with SciPy's DOP853."""

import numpy as np
from scipy.integrate import solve_ivp

T_R, T_A, BETA, W_FE = 1.7, 1.5, 7.0, 4.0
# Matrix W with the two weights of the printed matrix swapped: 0.40 between the tripods.
W = np.array([[0.0 if i == j else 0.04 if (i - j) % 2 == 0 else 0.40 for j in range(6)] for i in range(6)])
W_PRINTED = np.array([[0.0 if i == j else 0.40 if (i - j) % 2 == 0 else 0.04 for j in range(6)] for i in range(6)])


def derivative(y, *, coupling=W, w_fe=W_FE, tonic=1.0):
    """Return the time derivative of y = (u^e, u^f, v^e, v^f), six values each, one neuron at a time."""
    ue, uf, ve, vf = y.reshape(4, 6)
    rates = np.empty((4, 6))
    for i in range(6):
        others_e = sum(coupling[i, j] * max(0.0, ue[j]) for j in range(6))
        others_f = sum(coupling[i, j] * max(0.0, uf[j]) for j in range(6))
        rates[0, i] = (-ue[i] - w_fe * max(0.0, uf[i]) - BETA * ve[i] - others_e + tonic) / T_R
        rates[1, i] = (-uf[i] - w_fe * max(0.0, ue[i]) - BETA * vf[i] - others_f + tonic) / T_R
        rates[2, i] = (max(0.0, ue[i]) - ve[i]) / T_A
        rates[3, i] = (max(0.0, uf[i]) - vf[i]) / T_A
    return rates.ravel()


def solve(start, times, **network):
    """Return the states (steps, 4, 6) at `times` [time units] from `start` at time 0."""
    solution = solve_ivp(
        lambda t, y: derivative(y, **network),
        (0.0, times[-1]),
        np.asarray(start).ravel(),
        method="DOP853",
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
        max_step=0.05,
    )
    return solution.y.T.reshape(-1, 4, 6)


def period(start, *, duration=67.0, **network):
    """Return the mean time between upward zero crossings of the first unit's output, found as events of the solver."""

    def crossing(t, y):
        return y[0] - y[6]

    crossing.direction = 1
    solution = solve_ivp(
        lambda t, y: derivative(y, **network),
        (0.0, duration),
        np.asarray(start).ravel(),
        method="DOP853",
        events=crossing,
        rtol=1e-10,
        atol=1e-12,
        max_step=0.05,
    )
    times = solution.t_events[0]
    return (times[-1] - times[0]) / (len(times) - 1)
