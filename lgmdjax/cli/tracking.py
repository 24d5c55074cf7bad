"""`--track`: log the curves of fits to TensorBoard or to a function `log(step, values)` of the user."""

import contextlib
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import tracking, user_objects

TENSORBOARD = "tensorboard"
FOLDER = "tensorboard"  # in the run folder


def check(track: str) -> None:
    """Raise `InputError` for a --track that names no log; an empty one is allowed."""
    if track == TENSORBOARD:
        if find_spec("tensorboardX") is None:
            raise InputError(
                "expected tensorboardX for --track tensorboard, got an environment without it; "
                "pip install 'lgmdjax[tracking]'"
            )
    elif track:
        _find(track)


@contextlib.contextmanager
def log_to(track: str, run: Path) -> Iterator[None]:
    """Log the curves of fits as `track` says: not at all if empty, to event files in a run folder, or to a function."""
    check(track)
    if not track:
        yield
    elif track == TENSORBOARD:
        from tensorboardX import SummaryWriter

        with SummaryWriter(str(run / FOLDER)) as writer:

            def write(step: int, values: Mapping[str, float]) -> None:
                for name, value in values.items():
                    writer.add_scalar(name.replace(" ", "_"), value, step)

            print(f"look at the curves with `tensorboard --logdir {run / FOLDER}`", flush=True)
            with tracking.add_listener(write):
                yield
    else:
        with tracking.add_listener(_explaining(_find(track), track)):
            yield


def _find(track: str) -> tracking.Log:
    expected = f"expected --track {TENSORBOARD}, or module:function of a function log(step, values)"
    log = user_objects.find(track, expected)
    if not callable(log):
        raise InputError(f"{expected}, got {track}, which can't be called; name the function")
    return log


def _explaining(log: tracking.Log, name: str) -> tracking.Log:
    """Return the user's function, with its exceptions as one-line errors; the run can be resumed without it."""

    def explained(step: int, values: Mapping[str, float]) -> None:
        try:
            log(step, values)
        except Exception as error:  # whatever the user's function raises
            reason = one_line(f"{type(error).__name__}: {error}")[:200]
            raise InputError(
                f"expected {name} to take step {step}, got {reason}; fix it, or leave --track out"
            ) from error

    return explained
