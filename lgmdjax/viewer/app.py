"""`lgmdjax demo` and `lgmdjax view`: start the server, print the address of the page, and run the page."""

from dataclasses import dataclass
from pathlib import Path

from lgmdjax.paths import DATA_DIR
from lgmdjax.reporting import playback as playbacks
from lgmdjax.viewer import server as web
from lgmdjax.viewer.messages import Live, Walks
from lgmdjax.viewer.page import Viewer
from lgmdjax.viewer.walk_paths import find_walks

DEMO = DATA_DIR / "demo.npz"
"""The walk that comes with the package (`experiments/record_demo.py`)."""


@dataclass(frozen=True, kw_only=True)
class Address:
    """Where the page is served."""

    host: str = "127.0.0.1"
    port: int = 8080
    browser: bool = True


def run_demo(address: Address, out: Path) -> None:
    """Show the walk that comes with the package, until the user interrupts."""
    viewer = Viewer(web.start(address.host, address.port), out)
    viewer.play(Walks((), 0, playbacks.load(DEMO)))
    _announce(viewer, address)
    viewer.run()


def run_view(path: Path | None, address: Address, out: Path, live: Live) -> None:
    """Show recorded walks, or a live simulation if there is no path, until the user interrupts."""
    if path is not None:
        find_walks(path)
    viewer = Viewer(web.start(address.host, address.port), out, live.run)
    if path is None:
        viewer.play(Walks((), 0, playbacks.load(DEMO)))
        viewer.live_panel.room.value, viewer.live_panel.seed.value = live.room, live.seed
        viewer.start_live()
    else:
        viewer.open(path)
    _announce(viewer, address)
    viewer.run()


def _announce(viewer: Viewer, address: Address) -> None:
    where = web.address(viewer.server)
    opened = f" ({web.open_page(viewer.server)})" if address.browser else ""
    print(f"the robot is at {where}{opened}; Ctrl-C ends the viewer", flush=True)
