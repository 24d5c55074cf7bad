"""Robots in rooms: one frame, many frames, many robots, and recordings of them."""
