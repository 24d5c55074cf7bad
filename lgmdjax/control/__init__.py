"""From observations to left and right velocity: teacher, navigator, baselines, the whole controller (eqs. 17-22)."""
