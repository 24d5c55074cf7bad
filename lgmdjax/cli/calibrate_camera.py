"""`lgmdjax calibrate-camera`: fit a lens to pictures of a chessboard, and plot how far straight lines still bend."""

from collections.abc import Iterator

import numpy as np

from lgmdjax.cli.hardware_flags import CalibrateCameraFlags
from lgmdjax.errors import InputError
from lgmdjax.hardware import chessboard, lens
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import partial_files

SUFFIXES = (".json", ".yaml", ".yml")


def calibrate(flags: CalibrateCameraFlags) -> Iterator[str]:
    """Calibrate a camera; yield lines about the result and the names of the files."""
    if flags.out.suffix not in SUFFIXES:
        raise InputError(f"expected --out with a name that ends in {', '.join(SUFFIXES)}, got {flags.out}; rename it")
    if not flags.folder.is_dir():
        raise InputError(
            f"expected a folder with pictures of a chessboard, got {flags.folder}, which is not a folder; give another"
        )
    plot = flags.out.with_suffix(".png")
    if plot.parent.resolve() == flags.folder.resolve():
        raise InputError(
            f"expected --out outside of {flags.folder}, where its plot would be taken for a picture, got {flags.out}; "
            "choose another folder"
        )
    board = chessboard.parse_board(flags.board, flags.square)
    partial_files.require_writable(flags.out.parent)
    found = chessboard.calibrate(flags.folder, board, flags.model)
    with partial_files.replacing(plot) as partial:
        partial.write_bytes(style.to_png(chessboard.plot(found)))
    lens.write(flags.out, found.lens)
    left = np.rad2deg(chessboard.row_deviations(found))
    yield f"{len(found.used)} pictures used, {len(found.unused)} without the whole board"
    yield f"corners deviate by {found.error:.2f} px from where the lens maps them (root mean square)"
    mean = np.sqrt(np.mean(left**2))
    yield f"rows of corners bend by {mean:.3f} degrees (root mean square), {np.abs(left).max():.3f} at most"
    yield str(flags.out)
    yield str(plot)
