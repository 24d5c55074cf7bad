"""Make the animation at the top of the README: `python experiments/animate_walk.py` (three minutes on two cores).

The pretrained robot meets trees and bushes, fig. 15b of the paper. The first walk that passes them is shown: from
outside, through both eyes, and with the detectors' u and the commands v below.
"""

import io
import tempfile
from pathlib import Path

import av
import numpy as np
from PIL import Image

import lgmdjax as lj
from lgmdjax.runtime.jax_setup import prepare_jax

TRIAL, SEEDS, SEED = "outdoor", 4, 1
SECONDS = 60.0  # of walking
SHOWN = 9.0  # s of video, at twice real speed
WIDTH, QUALITY = 640, 55  # px and WebP quality of the animation
TARGET = Path(__file__).parents[1] / "docs" / "_static" / "walk.webp"


def main() -> None:
    """Walk, render, and write the animation."""
    robot = lj.load_robot()
    rooms = lj.evaluation.trials.sample_rooms(TRIAL, SEEDS, SEED)
    record = lj.rollout(robot, rooms, seconds=SECONDS)
    passed = lj.evaluation.trials.find_outcome(lj.evaluation.trials.TRIALS[TRIAL], record).passed
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder, "walk.mp4")
        lj.write_video(video, record, rooms, robot=robot, index=int(np.argmax(passed)), seconds=SHOWN)
        TARGET.write_bytes(to_webp(video))
    print(f"{TARGET}: {TARGET.stat().st_size / 1e6:.2f} MB")


def to_webp(video: Path) -> bytes:
    """Return a video as an animated WebP, which README pages show."""
    with av.open(str(video)) as container:
        rate = float(container.streams.video[0].average_rate or 12)
        images = [frame.to_image() for frame in container.decode(video=0)]
    height = round(images[0].height * WIDTH / images[0].width)
    frames = [image.resize((WIDTH, height), Image.Resampling.LANCZOS) for image in images]
    out = io.BytesIO()
    frames[0].save(
        out, "WEBP", save_all=True, append_images=frames[1:], duration=round(1000 / rate), loop=0, quality=QUALITY
    )
    return out.getvalue()


if __name__ == "__main__":
    prepare_jax()  # before JAX is imported, which the first use of the package does
    main()
