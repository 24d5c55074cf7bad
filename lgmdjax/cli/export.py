"""`lgmdjax export`: the nervous system of a robot in one folder, and a line about each file."""

from collections.abc import Iterator

from lgmdjax.cli.flags import ExportFlags
from lgmdjax.deployment import exporter


def export_robot(flags: ExportFlags) -> Iterator[str]:
    """Export a robot; yield a line about each file, and one about the memory that the C program needs."""
    card = exporter.export(flags.run(), flags.out, width=flags.width, formats=flags.formats)
    for name, file in card["files"].items():
        yield f"{flags.out / name}: {file['bytes'] / 1e3:.1f} kB"
    yield f"{flags.out / 'card.json'}: what to connect where"
    if "c" in flags.formats:
        state, constants = (card["memory"][part] / 1e3 for part in ("state", "constants"))
        yield f"static memory of the C program: {state:.1f} kB of state, {constants:.1f} kB of constants"
