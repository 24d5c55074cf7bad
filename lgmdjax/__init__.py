"""Walking hexapod with insect eyes: LGMD collision detectors, a central pattern generator, a learned navigator.

The parts are plain modules, each importable and usable alone (`lgmdjax.detectors.lgmd`, `lgmdjax.locomotion.cpg`,
...); nothing heavy is imported here, so that `import lgmdjax` and `lgmdjax --help` answer at once.
"""

__version__ = "0.1.0"
