"""Eqs. 18-22, transcribed from the paper."""


def vehicle_2a(u_l: float, u_r: float, v_base: float, k_2a: float) -> tuple[float, float]:
    return v_base + k_2a * u_l, v_base + k_2a * u_r


def vehicle_2b(u_l: float, u_r: float, v_base: float, k_2b: float) -> tuple[float, float]:
    return v_base + k_2b * u_r, v_base + k_2b * u_l


def vehicle_3a(u_l: float, u_r: float, v_base: float, k_3a: float) -> tuple[float, float]:
    return v_base - k_3a * u_l, v_base - k_3a * u_r


def vehicle_3b(u_l: float, u_r: float, v_base: float, k_3b: float) -> tuple[float, float]:
    return v_base - k_3b * u_r, v_base - k_3b * u_l


def rule(d_l: float, d_r: float, v_base: float = 1.2, k_2a: float = 0.8, k_3b: float = 0.6) -> tuple[float, float]:
    v_l = v_base + k_2a * (1 / d_l) - k_3b * (1 / d_r)
    v_r = v_base + k_2a * (1 / d_r) - k_3b * (1 / d_l)
    return v_l, v_r
