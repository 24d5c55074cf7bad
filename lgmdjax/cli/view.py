"""`lgmdjax demo` and `lgmdjax view`: the robot in the browser."""

from lgmdjax.cli.flags import DemoFlags, ViewFlags
from lgmdjax.reporting import walk_scene
from lgmdjax.viewer import app
from lgmdjax.viewer.app import Address
from lgmdjax.viewer.messages import Live


def show_demo(flags: DemoFlags) -> None:
    """Show the walk that comes with the package, until the user interrupts."""
    walk_scene.check_installed()
    app.run_demo(_address(flags), flags.out)


def show_walks(flags: ViewFlags) -> None:
    """Show recorded walks, or a live simulation, until the user interrupts."""
    walk_scene.check_installed()
    app.run_view(flags.path, _address(flags), flags.out, Live(flags.room, flags.seed, flags.run))


def _address(flags: DemoFlags) -> Address:
    return Address(host=flags.host, port=flags.port, browser=flags.browser)
