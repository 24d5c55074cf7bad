"""The hexapod in MuJoCo MJX, and a physics step that reverse mode can differentiate."""
