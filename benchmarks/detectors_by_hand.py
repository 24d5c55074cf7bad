"""The looming detectors in OpenCV and NumPy, as one would write them without JAX: vectorised, float32, of one thread.

Each is made from its `Params` and a first frame; a call with the next frame returns u and the excitation. The equations
and their symbols are those of `lgmdjax/detectors`. Constants are free but for D-LGMD's, which must leave its kernels
separable; options (pooling, smooth and the like) have their defaults. What a weight of zero makes vanish is left out.
Weighted sums over neighbours are linear, so weights and delays are folded into the kernels. Layers that are no longer
needed are overwritten.
"""

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from lgmdjax.detectors import cells, d_lgmd, dsn, emd, grm, lgmd, lgmd1_grouping, lgmd1_onoff, lgmd2, lplc2

Step = Callable[[np.ndarray], tuple[float, float]]  # a frame to u and the excitation

CELL = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]], np.float32)
NEAREST = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32)
DIAGONAL = np.array([[1, 0, 1], [0, 0, 0], [1, 0, 1]], np.float32)


class LGMD:
    """Blanchard et al. 2000."""

    def __init__(self, p: lgmd.Params, L: np.ndarray):
        self.kernel = np.asarray(p.kernel, np.float32)
        self.W_I, self.T_s, self.T_f = float(p.inhibition), float(p.threshold), float(p.suppression)
        self.L, self.P, self.I = L, np.zeros_like(L), np.empty_like(L)

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        FF = mean_magnitude(self.P)
        cv2.filter2D(self.P, -1, self.kernel, dst=self.I, borderType=cv2.BORDER_CONSTANT)
        S = cv2.scaleAdd(np.abs(self.I, out=self.I), -self.W_I, cv2.absdiff(L, self.L), dst=self.I)
        U = mean(passing(S, self.T_s))
        cv2.subtract(L, self.L, dst=self.P)
        self.L = L
        return (cells.U_AT_REST if self.T_f < FF else sigmoid(U)), U


class LGMD1Grouping:
    """Yue & Rind 2006."""

    def __init__(self, p: lgmd1_grouping.Params, L: np.ndarray):
        self.p, self.L, self.P = p, L, np.zeros_like(L)
        self.kernel = -float(p.inhibition) * (float(p.nearest) * NEAREST + float(p.diagonal) * DIAGONAL)

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        p, F, P = self.p, mean_magnitude(self.P), cv2.subtract(L, self.L)
        if p.persistence:
            cv2.scaleAdd(self.P, float(p.persistence), P, dst=P)
        S = filter_repeating_border(self.P, self.kernel)
        K = mean(grouped(p, cv2.add(S, P, dst=S)))
        self.L, self.P = L, P
        return (cells.U_AT_REST if p.suppression <= F else sigmoid(K)), K


class OnOff:
    """ON and OFF channels and adaptation, which the two detectors of Fu et al. share."""

    def __init__(self, p: lgmd1_onoff.Params | lgmd2.Params, L: np.ndarray):
        self.residual, self.T_sfa = float(p.residual), float(p.adaptation_threshold)
        self.h = float(p.adaptation_time) / (p.frame_time + float(p.adaptation_time))
        self.L, self.on, self.off = L, np.zeros_like(L), np.zeros_like(L)
        self.mean_change, self.k, self.u = 0.0, cells.U_AT_REST, cells.U_AT_REST

    def split(self, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the next activity of both channels."""
        on, off = np.maximum(P, 0), np.maximum(np.negative(P, out=P), 0, out=P)
        cv2.scaleAdd(self.on, self.residual, on, dst=on)
        cv2.scaleAdd(self.off, self.residual, off, dst=off)
        return on, off

    def adapt(self, k: float) -> None:
        """Let the response decay unless the potential rises."""
        rise = k - self.k
        self.k, self.u = k, max((k if rise > self.T_sfa else self.u + rise) * self.h, cells.U_AT_REST)


class LGMD1OnOff(OnOff):
    """Fu et al. 2018."""

    def __init__(self, p: lgmd1_onoff.Params, L: np.ndarray):
        super().__init__(p, L)
        self.p, self.a_F = p, share(p.frame_time, p.suppression_delay)
        weights = 0.0, float(p.nearest), float(p.diagonal)
        now, before = delayed_kernels(weights, (0.0, float(p.delay_nearest), float(p.delay_diagonal)), p.frame_time)
        self.on_kernels = CELL - float(p.on_inhibition) * now, -float(p.on_inhibition) * before
        self.off_kernels = now - float(p.off_inhibition) * CELL, before

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        p, P = self.p, cv2.subtract(L, self.L)
        self.mean_change += self.a_F * (mean_magnitude(P) - self.mean_change)
        on, off = self.split(P)
        S_on, S_off = filter_twice(self.on, on, self.on_kernels), filter_twice(self.off, off, self.off_kernels)
        self.L, self.on, self.off = L, on, off
        S = passing(joined(p, S_on, S_off), float(p.threshold))
        K = mean(cv2.blur(S, (3, 3), borderType=cv2.BORDER_REPLICATE))
        self.adapt(sigmoid(K / float(p.scale)))
        if p.suppression <= self.mean_change:
            self.k = self.u = cells.U_AT_REST
        return self.u, K


class LGMD2(OnOff):
    """Fu et al. 2020."""

    def __init__(self, p: lgmd2.Params, L: np.ndarray):
        super().__init__(p, L)
        self.p, self.a_PM = p, share(p.frame_time, p.mediation_delay)
        self.on_kernels = delayed_kernels(np.asarray(p.on_kernel), np.asarray(p.on_delays), p.frame_time)
        self.off_kernels = delayed_kernels(np.asarray(p.off_kernel), np.asarray(p.off_delays), p.frame_time)

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        p, P = self.p, cv2.subtract(L, self.L)
        self.mean_change += self.a_PM * (mean_magnitude(P) - self.mean_change)
        on, off = self.split(P)
        S_on = self.inhibited(self.on, on, self.on_kernels, float(p.on_inhibition))
        S_off = self.inhibited(self.off, off, self.off_kernels, float(p.off_inhibition))
        self.L, self.on, self.off = L, on, off
        K = mean(grouped(p, joined(p, S_on, S_off)))
        self.adapt(sigmoid(K / float(p.scale)))
        return self.u, K

    def inhibited(
        self, before: np.ndarray, now: np.ndarray, kernels: tuple[np.ndarray, np.ndarray], least: float
    ) -> np.ndarray:
        """Return what inhibition leaves of a channel."""
        W = np.float32(max(self.mean_change / float(self.p.mediation_scale), least))
        S = filter_twice(before, now, (CELL - W * kernels[0], -W * kernels[1]))
        return np.maximum(S, 0, out=S)


class DLGMD:
    """Zhao et al. 2021.

    The kernels of 13 x 13 cells are Gaussians, which are separable, but for the few cells without latency. With their
    kernel N the sums are g_E * P_f - N * (P_f - P_{f-1}) - a g_I * P_{f-1}.
    """

    def __init__(self, p: d_lgmd.Params, L: np.ndarray):
        self.L, self.P, self.P_before = L, np.zeros_like(L), np.zeros_like(L)
        self.s_E, self.s_I, a = float(p.excitation_sigma), float(p.inhibition_sigma), float(p.inhibition)
        self.T_0, self.T_max, self.gain = float(p.threshold), float(p.max_threshold), float(p.gain)
        x = np.arange(-d_lgmd.RADIUS, d_lgmd.RADIUS + 1)
        squared = x**2 + x[:, None] ** 2
        E, I = (np.exp(-squared / (2 * s**2)) / (s * math.sqrt(2 * math.pi)) for s in (self.s_E, self.s_I))  # noqa: E741
        self.sum_E, self.sum_I = float(E.sum()), float(a * I.sum())  # OpenCV's Gaussians have the sum 1
        tau = float(p.latency_offset) + 1 / (float(p.latency_shape) + np.exp(-(float(p.latency_spread) ** 2) * squared))
        at_once = tau < 1
        if (tau >= 2).any() or (a * I > E)[at_once].any():
            raise ValueError("expected latencies below 2 and no more inhibition than excitation at once")
        n = int(np.abs(x[at_once.any(axis=0)]).max(initial=0))
        near = slice(d_lgmd.RADIUS - n, d_lgmd.RADIUS + n + 1)
        self.N = (a * I * at_once)[near, near].astype(np.float32)

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        T_G = min(self.T_0 * mean(self.P_before), self.T_max)
        before, self.P_before = self.P, self.P
        P = cv2.absdiff(L, self.L)
        P *= np.float32(1 / d_lgmd.GREY)
        self.L, self.P = L, P
        S = cv2.addWeighted(blur(P, self.s_E), self.sum_E, blur(before, self.s_I), -self.sum_I, 0)
        S -= cv2.filter2D(cv2.subtract(P, before), -1, self.N, borderType=cv2.BORDER_CONSTANT)
        np.maximum(S, 0, out=S)
        side = d_lgmd.GROUP
        # OpenCV's anchor of an even kernel is one cell farther than that of MATLAB's conv2.
        Ce = cv2.blur(S, (side, side), anchor=(side // 2 - 1, side // 2 - 1), borderType=cv2.BORDER_CONSTANT)
        K = mean(np.minimum(passing(cv2.multiply(S, Ce, dst=Ce), T_G), 1, out=Ce))
        return sigmoid(self.gain * K), K


class DSN:
    """Yue & Rind 2007 and 2013."""

    def __init__(self, p: dsn.Params, L: np.ndarray):
        self.L, self.changes = L, [np.zeros_like(L) for _ in range(p.delay)]
        self.T_s, self.T_FFI = float(p.threshold), float(p.suppression)
        w = float(p.decay) ** np.arange(p.reach)
        ahead = (-float(p.inhibition) * np.r_[0, w / w.sum()]).astype(np.float32)
        behind, n = ahead[::-1], p.reach
        # For motion to the left, right, up and down: what spreads to the left comes from the cells on the right.
        self.kernels = [
            (ahead[None], (0, 0)),
            (behind[None], (n, 0)),
            (ahead[:, None], (0, 0)),
            (behind[:, None], (0, n)),
        ]

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        F, P = mean(self.changes[-1]), cv2.absdiff(L, self.L)
        K = [self.network(P, *kernel) for kernel in self.kernels]
        self.L, self.changes = L, [*self.changes[1:], P]
        E = math.exp(sum(map(math.log, K)) / len(K)) if min(K) > 0 else 0.0
        return (cells.U_AT_REST if self.T_FFI <= F else sigmoid(E)), E

    def network(self, P: np.ndarray, kernel: np.ndarray, anchor: tuple[int, int]) -> float:
        """Return the mean response of the network that does not see motion in one direction."""
        inhibition = cv2.filter2D(self.changes[0], -1, kernel, anchor=anchor, borderType=cv2.BORDER_CONSTANT)
        return mean(passing(cv2.add(P, inhibition, dst=inhibition), self.T_s))


class Correlators:
    """The signals of Hassenstein & Reichardt's detectors, which three detectors share."""

    def __init__(self, p: emd.Params, L: np.ndarray):
        self.L, self.H, self.D = L, np.zeros_like(L), np.zeros_like(L)
        self.h = float(p.adaptation_time) / (p.frame_time + float(p.adaptation_time))
        self.a = share(p.frame_time, p.delay)

    def filter(self, L: np.ndarray) -> None:
        """Take up the next frame."""
        change = cv2.subtract(L, self.L)
        cv2.addWeighted(self.H, self.h, change, self.h / emd.GREY, 0, dst=self.H)
        cv2.addWeighted(self.D, 1 - self.a, self.H, self.a, 0, dst=self.D)
        self.L = L


class EMD(Correlators):
    """Hassenstein & Reichardt 1956."""

    def __init__(self, p: emd.Params, L: np.ndarray):
        super().__init__(p, L)
        self.gain = float(p.gain)

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        self.filter(L)
        E = max(outward(self.H.T, self.D.T) + outward(self.H, self.D), 0.0)
        return sigmoid(self.gain * E), E


class GRM(Correlators):
    """Chalupka et al. 2016."""

    def __init__(self, p: grm.Params, L: np.ndarray):
        super().__init__(p.motion, L)
        self.gain = float(p.gain)

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        self.filter(L)
        n = (L.shape[1] + 1) // 2
        left, right = np.s_[:, :n], np.s_[:, L.shape[1] - n :]
        g_l = mean(passing(rightward(self.H[left], self.D[left]), 0.0))
        g_r = mean(passing(rightward(self.D[right], self.H[right]), 0.0))  # exchanged, so leftward
        return sigmoid(self.gain * (g_l + g_r)), g_l + g_r


class LPLC2(Correlators):
    """Klapoetke et al. 2017 and Zhou et al. 2022."""

    def __init__(self, p: lplc2.Params, L: np.ndarray):
        super().__init__(p.motion, L)
        self.b_e, self.b_i, self.gain = float(p.intercept), float(p.inhibition_intercept), float(p.gain)
        self.every = np.s_[:: p.stride, :: p.stride]
        weights = [np.asarray(w, np.float32) for w in (p.excitation_weights, p.inhibition_weights)]
        self.kernels = [[np.rot90(w, turns).copy() for w in weights] for turns in range(4)]

    def __call__(self, L: np.ndarray) -> tuple[float, float]:
        self.filter(L)
        R, U = rightward(self.H, self.D), upward(self.H, self.D)
        half = lplc2.SCALE / 2
        right = cv2.addWeighted(R[:-1], half, R[1:], half, 0)
        up = cv2.addWeighted(U[:, :-1], half, U[:, 1:], half, 0)
        r = np.full_like(right[self.every], self.b_e)
        for motion, (w_e, w_i) in zip((right, up, -right, -up), self.kernels, strict=True):
            M = passing(motion, 0.0)
            r += cv2.filter2D(M, -1, w_e, borderType=cv2.BORDER_CONSTANT)[self.every]
            r -= np.maximum(cv2.filter2D(M, -1, w_i, delta=self.b_i, borderType=cv2.BORDER_CONSTANT)[self.every], 0)
        E = mean(np.maximum(r, 0, out=r))
        return sigmoid(self.gain * E), E


BY_HAND = {
    lgmd: LGMD,
    lgmd1_grouping: LGMD1Grouping,
    lgmd1_onoff: LGMD1OnOff,
    lgmd2: LGMD2,
    d_lgmd: DLGMD,
    dsn: DSN,
    emd: EMD,
    grm: GRM,
    lplc2: LPLC2,
}


def sigmoid(x: float) -> float:
    """Return the logistic function of x >= 0."""
    return 1 / (1 + math.exp(-x))


def share(frame_time: float, time_constant: cells.Scalar) -> float:
    """Return the share of the new value in a filter of the first order."""
    return frame_time / (frame_time + float(time_constant))


def mean(layer: np.ndarray) -> float:
    """Return the mean, summed in double precision."""
    return cv2.mean(layer)[0]


def mean_magnitude(layer: np.ndarray) -> float:
    """Return the mean of |x|."""
    return cv2.norm(layer, cv2.NORM_L1) / layer.size


def passing(layer: np.ndarray, threshold: float) -> np.ndarray:
    """Set a layer to zero where it is not above the threshold, and return it."""
    return cv2.threshold(layer, threshold, 0, cv2.THRESH_TOZERO, dst=layer)[1]


def blur(layer: np.ndarray, sigma: float) -> np.ndarray:
    """Return a layer blurred by a Gaussian that ends at the radius of D-LGMD."""
    side = 2 * d_lgmd.RADIUS + 1
    return cv2.GaussianBlur(layer, (side, side), sigma, borderType=cv2.BORDER_CONSTANT)


def filter_repeating_border(layer: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return the weighted sum over 3 x 3 cells; cells on the border replace missing ones."""
    return cv2.filter2D(layer, -1, kernel, borderType=cv2.BORDER_REPLICATE)


def filter_twice(before: np.ndarray, now: np.ndarray, kernels: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the present activity filtered by the first kernel plus the last activity filtered by the second."""
    S = filter_repeating_border(now, kernels[0])
    return cv2.add(S, filter_repeating_border(before, kernels[1]), dst=S)


def delayed_kernels(
    weights: Sequence[float] | np.ndarray, delays: Sequence[float] | np.ndarray, frame_time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the present and of the last activity of a cell, its nearest and its diagonal neighbours."""
    now, before = np.zeros_like(CELL), np.zeros_like(CELL)
    for w, delay, part in zip(weights, delays, (CELL, NEAREST, DIAGONAL), strict=True):
        a = share(frame_time, delay)
        now += float(w) * a * part
        before += float(w) * (1 - a) * part
    return now, before


def joined(p: lgmd1_onoff.Params | lgmd2.Params, S_on: np.ndarray, S_off: np.ndarray) -> np.ndarray:
    """Return S of both channels."""
    S = cv2.addWeighted(S_on, float(p.on_weight), S_off, float(p.off_weight), 0)
    if p.joint_weight:
        cv2.add(S, cv2.multiply(S_on, S_off, dst=S_on, scale=float(p.joint_weight)), dst=S)
    return S


def grouped(p: lgmd1_grouping.Params | lgmd2.Params, S: np.ndarray) -> np.ndarray:
    """Return G = S Ce / w, and 0 below the threshold."""
    Ce = cv2.blur(S, (3, 3), borderType=cv2.BORDER_REPLICATE)
    w = float(p.group_offset) + cv2.norm(Ce, cv2.NORM_INF) / float(p.group_share)
    return passing(cv2.multiply(S, Ce, dst=Ce, scale=1 / w), float(p.threshold) / float(p.decay))


def rightward(H: np.ndarray, D: np.ndarray) -> np.ndarray:
    """Return R of neighbouring columns."""
    R = cv2.multiply(D[:, :-1], H[:, 1:])
    return cv2.subtract(R, cv2.multiply(H[:, :-1], D[:, 1:]), dst=R)


def upward(H: np.ndarray, D: np.ndarray) -> np.ndarray:
    """Return U of neighbouring rows."""
    U = cv2.multiply(D[1:], H[:-1])
    return cv2.subtract(U, cv2.multiply(H[1:], D[:-1]), dst=U)


def outward(H: np.ndarray, D: np.ndarray) -> float:
    """Return the mean motion along the first axis, away from the middle."""
    n, pairs = len(H), H.size - H.shape[1]
    before, after = np.s_[: (n + 1) // 2], np.s_[n // 2 :]
    return (onward(H[after], D[after]) - onward(H[before], D[before])) / pairs


def onward(H: np.ndarray, D: np.ndarray) -> float:
    """Return the sum of the motion along the first axis; no layer of products is written."""
    return float(np.einsum("ij,ij", D[:-1], H[1:]) - np.einsum("ij,ij", H[:-1], D[1:]))
