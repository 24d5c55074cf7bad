"""Record the walk of `lgmdjax demo`: `python experiments/record_demo.py`, ten minutes or less on 2 cores.

The pretrained robot in the trial in which boxes move into its way, with the cameras of its training: the first 40 s of
the first walk, in which it touches the second box. Writes lgmdjax/data/demo.npz.
"""

from lgmdjax.evaluation import run_trial
from lgmdjax.paths import DATA_DIR
from lgmdjax.reporting import playback
from lgmdjax.runtime.storage import write_stamp
from lgmdjax.viewer.messages import Open
from lgmdjax.viewer.sources import WalkSource

SEED, WALK = 31, 0
SECONDS = 40


def main() -> None:
    """Run the trial, render what the robot saw in one of its walks, and write both."""
    folder = run_trial.run_trial("dynamic", "learned", seed=SEED)
    source = WalkSource(Open(folder, WALK), print)
    frames = SECONDS * playback.FRAME_RATE
    whole = source.sense_all(frames)
    walk = playback.cut(whole, frames)._replace(title="Boxes move into the way")
    playback.save(DATA_DIR / "demo.npz", walk)
    write_stamp(DATA_DIR, {})


if __name__ == "__main__":
    main()
