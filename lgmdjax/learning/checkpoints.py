"""Progress of a fit on disk (orbax). An interrupted fit resumes and gives the same result, bit for bit.

Each checkpoint stores the identity of its fit, a fingerprint of data, settings and initial weights. A fit with
another identity refuses the checkpoint. Only the newest checkpoint is kept; one that was interrupted while it was
written is ignored. The checksum of the progress is stored with the identity; checkpoints of versions before 0.3.0 have
none. A checkpoint is refused if an array that was finite at the start of the fit is not finite in it.

Of several processes that compute one fit (`lgmdjax.runtime.distributed`) the first writes and reads the checkpoints.
"""

import json
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import checksums, distributed, interruption
from lgmdjax.runtime.storage import JsonObject

Progress = TypeVar("Progress")


class Checkpoints:
    """A folder with the checkpoints of one fit.

    Args:
        folder: created if it does not exist.
        identity: JSON values that distinguish this fit from any other.
    """

    def __init__(self, folder: Path | str, identity: JsonObject):
        for name in ("absl", "asyncio"):  # orbax logs a line for every file, and errors that it raises as well
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self.folder, self.identity = Path(folder).absolute(), json.loads(json.dumps(identity))
        if not distributed.is_first():
            return
        own, is_single = jax.process_index(), jax.process_count() == 1
        options = ocp.CheckpointManagerOptions(
            max_to_keep=1,
            create=is_single,  # orbax refuses to if only some of several processes save
            enable_async_checkpointing=False,
            multiprocessing_options=ocp.options.MultiprocessingOptions(
                primary_host=own, active_processes=None if is_single else {own}
            ),
        )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.manager = ocp.CheckpointManager(self.folder, options=options)
        except Exception as error:
            raise InputError(
                f"{folder}: expected a folder for checkpoints, got {_first_line(error)}; choose another"
            ) from error

    def restore_latest(self, initial: Progress) -> tuple[int, Progress]:
        """Return the newest checkpoint as (step, progress), or (0, `initial`) if there is none.

        `initial` also gives structure, shapes and dtypes of what is read. All processes return that of the first.
        """
        if distributed.count() == 1:
            return self._restore(initial)
        found = self._restore(initial) if distributed.is_first() else (0, initial)
        step, progress = distributed.share_arrays(f"{self.folder}: checkpoint", (np.asarray(found[0]), found[1]))
        return int(step), progress

    def _restore(self, initial: Progress) -> tuple[int, Progress]:
        step = self.manager.latest_step()
        if step is None:
            return 0, initial
        template = jax.tree.map(ocp.utils.to_shape_dtype_struct, _for_orbax(initial))
        try:
            identity = ocp.args.Composite(belongs=ocp.args.JsonRestore())  # pyright: ignore
            found = self.manager.restore(step, args=identity)["belongs"]
            self._require_same_identity(found)
            contents = ocp.args.Composite(progress=ocp.args.StandardRestore(template))  # pyright: ignore
            restored = self.manager.restore(step, args=contents)["progress"]
            if found.get(checksums.CHECKSUM_KEY) not in (None, _digest(restored)):
                raise checksums.ChecksumError("another checksum than the saved one")
            if not all(jax.tree.leaves(jax.tree.map(_is_as_finite, initial, restored))):
                raise checksums.ChecksumError("numbers that are not finite")
        except InputError:
            raise
        except Exception as error:  # orbax raises whatever its storage layer does
            raise InputError(
                f"{self.folder}: expected a whole checkpoint, got {_first_line(error)}; remove it to start again"
            ) from error
        # Orbax commits arrays to one device; JAX refuses to combine those with arrays sharded over several.
        return step, jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), restored)

    def save(self, step: int, progress: PyTree) -> None:
        """Write progress; it is complete on disk when this returns."""
        if not distributed.is_first():
            return
        progress = _for_orbax(progress)
        identity = self.identity | {checksums.CHECKSUM_KEY: _digest(progress)}
        args = ocp.args.Composite(
            progress=ocp.args.StandardSave(progress),  # pyright: ignore
            belongs=ocp.args.JsonSave(identity),  # pyright: ignore  (the identity's name on disk)
        )
        try:
            self.manager.save(step, args=args)
            self.manager.wait_until_finished()
        except Exception as error:  # on a full disk orbax raises whatever its storage layer does
            raise InputError(f"{self.folder}: expected to write, got {_first_line(error)}; free some disk") from error

    def close(self) -> None:
        """Close the folder."""
        if not distributed.is_first():
            return
        try:
            self.manager.close()
        except Exception as error:
            raise InputError(f"{self.folder}: expected to write, got {_first_line(error)}; free some disk") from error

    def _require_same_identity(self, found: JsonObject) -> None:
        # A name that only one of the two has is from another version of the package.
        names = sorted(name for name in self.identity.keys() & found.keys() if found[name] != self.identity[name])
        if names:
            raise InputError(
                f"{self.folder}: expected checkpoints of the same fit, got another {', '.join(names)}; "
                "remove them, or choose another folder"
            )


def resumable(
    advance: Callable[[Progress, int, int], Progress],
    initial: Progress,
    checkpoints: Checkpoints | None,
    *,
    total: int,
    chunk: int = 1,
    interval: float = 0.0,
) -> Iterator[tuple[int, Progress]]:
    """Advance progress from its newest checkpoint to step `total`; yield (step, progress) first and after each chunk.

    Args:
        advance: `advance(progress, step, end)` returns the progress at step `end`.
        initial: progress at step 0.
        checkpoints: where progress is saved and resumed from; None saves nothing.
        total: number of steps.
        chunk: steps in one call of `advance`.
        interval: minimum time between two checkpoints [s]; the last step is always saved.

    >>> list(resumable(lambda progress, step, end: progress + (end - step), 0, None, total=5, chunk=2))
    [(0, 0), (2, 2), (4, 4), (5, 5)]
    """
    step, progress = (0, initial) if checkpoints is None else checkpoints.restore_latest(initial)
    last_saved = time.monotonic()
    yield step, progress
    while step < total:
        end = min(step + chunk, total)
        progress = jax.block_until_ready(advance(progress, step, end))
        step = end
        interruption.check()
        if checkpoints is not None and (step == total or time.monotonic() - last_saved >= interval):
            checkpoints.save(step, progress)
            last_saved = time.monotonic()
        yield step, progress


def _for_orbax(progress: Progress) -> Progress:
    """Return progress as orbax can write it: of several processes, it refuses arrays that are on devices of one."""
    return jax.tree.map(np.asarray, progress) if jax.process_count() > 1 else progress


def _digest(progress: PyTree) -> str:
    """Return the checksum of all numbers, with their types and shapes."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(progress)]
    return checksums.digest(repr([(str(leaf.dtype), leaf.shape, leaf.tobytes()) for leaf in leaves]).encode())


def _is_as_finite(initial: PyTree, restored: PyTree) -> bool:
    """Tell whether numbers are finite, or were not at the start: curves are nan where they are unknown."""
    return bool(np.isfinite(restored).all() or not np.isfinite(initial).all())


def _first_line(error: Exception) -> str:
    return one_line(f"{type(error).__name__}: {error}".split("\n")[0])[:200]
