"""Rhythm and legs: oscillators, shaping networks, the tripod gait, leg kinematics (eqs. 1-6)."""
