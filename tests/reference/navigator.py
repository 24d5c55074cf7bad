"""Keras's LSTM layer followed by a dense layer in NumPy, from the formulas in its documentation."""

import numpy as np


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def lstm(
    x: np.ndarray, W: np.ndarray, U: np.ndarray, b: np.ndarray, head: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Run keras.layers.LSTM(units, return_sequences=True) with its default activations, then Dense(linear).

    W (inputs, 4 units), U (units, 4 units), b (4 units,), in Keras's order of gates: i, f, c, o.
    """
    units = U.shape[0]
    h, c, outputs = np.zeros(units), np.zeros(units), []
    for x_t in x:
        z = x_t @ W + h @ U + b
        z_i, z_f, z_c, z_o = (z[k * units : (k + 1) * units] for k in range(4))
        i, f, o = sigmoid(z_i), sigmoid(z_f), sigmoid(z_o)
        c = f * c + i * np.tanh(z_c)
        h = o * np.tanh(c)
        outputs.append(h @ head + offset)
    return np.array(outputs)
