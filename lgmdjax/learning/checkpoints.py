"""Progress of a fit on disk (orbax), to carry on from after an interruption: the same result, bit for bit.

A checkpoint knows what it belongs to, a fingerprint of data, settings and first weights, and is refused by
any other fit. Only the newest is kept; one that was not finished is not seen.
"""

import json
import logging
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from lgmdjax.errors import InputError

Progress = TypeVar("Progress")


class Checkpoints:
    """A folder of checkpoints of one fit.

    Args:
        folder: made if it is not there.
        belongs: JSON values that tell this fit from others.
    """

    def __init__(self, folder: Path | str, belongs: dict[str, Any]):
        logging.getLogger("absl").setLevel(logging.ERROR)  # orbax tells of every file
        self.folder, self.belongs = Path(folder).absolute(), json.loads(json.dumps(belongs))
        options = ocp.CheckpointManagerOptions(max_to_keep=1, create=True, enable_async_checkpointing=False)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.manager = ocp.CheckpointManager(self.folder, options=options)
        except (OSError, ValueError) as error:
            raise InputError(
                f"{folder}: expected a folder for checkpoints, got {_line(error)}; choose another"
            ) from error

    def latest(self, start: Progress) -> Progress:
        """Read the newest progress, or return `start` if there is none; it also gives shapes and dtypes."""
        step = self.manager.latest_step()
        if step is None:
            return start
        template = jax.tree.map(ocp.utils.to_shape_dtype_struct, start)
        try:
            tag = ocp.args.Composite(belongs=ocp.args.JsonRestore())  # pyright: ignore
            self._require_own(self.manager.restore(step, args=tag)["belongs"])
            wanted = ocp.args.Composite(progress=ocp.args.StandardRestore(template))  # pyright: ignore
            restored = self.manager.restore(step, args=wanted)["progress"]
        except InputError:
            raise
        except Exception as error:  # orbax raises whatever its storage layer does
            raise InputError(
                f"{self.folder}: expected a whole checkpoint, got {_line(error)}; remove it to start again"
            ) from error
        # Orbax ties them to a device, and what is tied to one cannot meet a crowd that is dealt out to several.
        return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), restored)

    def save(self, step: int, progress: Any) -> None:
        """Write progress; it is complete on disk when this returns."""
        args = ocp.args.Composite(
            progress=ocp.args.StandardSave(progress),  # pyright: ignore
            belongs=ocp.args.JsonSave(self.belongs),  # pyright: ignore
        )
        try:
            self.manager.save(step, args=args)
            self.manager.wait_until_finished()
        except OSError as error:
            raise InputError(f"{self.folder}: expected to write, got {_line(error)}; free some disk") from error

    def close(self) -> None:
        """Let go of the folder."""
        self.manager.close()

    def _require_own(self, belongs: dict[str, Any]) -> None:
        names = sorted(name for name in self.belongs if belongs.get(name) != self.belongs[name])
        if names:
            raise InputError(
                f"{self.folder}: expected checkpoints of the same fit, got another {', '.join(names)}; "
                "remove them, or choose another folder"
            )


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".split("\n")[0][:200]
