"""Teach the shaping networks that come with the package: `python experiments/teach_gait.py`."""

from pathlib import Path

import jax

from lgmdjax import gait, hexapod, shaping

SEED = 1
STEPS = 6000
OUT = Path(shaping.__file__).parent / "data" / "shaping.safetensors"


def main() -> None:
    """Fit for half a minute, telling the loss, and write the file."""
    geometry = gait.geometry(hexapod.load())
    networks = gait.teach(
        geometry,
        key=jax.random.key(SEED),
        steps=STEPS,
        progress=lambda step, loss: print(f"step {step:5d} of {STEPS}: loss {loss:.4f} mm^2"),
    )
    shaping.save(OUT, networks, {"seed": SEED, "steps": STEPS, "cycle_time": gait.Gait().cycle_time})
    print(OUT)


if __name__ == "__main__":
    main()
