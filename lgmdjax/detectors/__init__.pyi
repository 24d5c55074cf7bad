from . import lgmd as lgmd
