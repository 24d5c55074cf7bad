"""Start the libraries that read environment variables, and say in one line which of them does not start, and why."""

from collections.abc import Callable

from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import jax_setup


def check_jax() -> None:
    """Make JAX check what it reads from its cache; raise `InputError` for variables with which JAX can't start."""
    jax_setup.check_variables()
    from lgmdjax.runtime import program_cache

    program_cache.protect()


def check() -> None:
    """Raise `InputError` if a library does not start here; the message names variables and values. Takes seconds."""
    jax_setup.check_variables()
    for name, start in LIBRARIES.items():
        try:
            start()
        except Exception as error:  # a library may raise anything for a variable that it can't read
            raise InputError(_fault(name, error)) from error


def explain(error: Exception) -> str:
    """Return what is wrong with the environment; empty if the error has another cause."""
    if type(error).__name__ == "JaxRuntimeError" and "RESOURCE_EXHAUSTED" in str(error):
        return f"expected more memory, got {one_line(error)[:200]}; run fewer robots at once"
    if isinstance(error, RuntimeError) and "start new thread" in str(error):
        return f"expected to start a thread, got {one_line(error)}; allow more processes or memory (ulimit)"
    if "Unable to initialize backend" in str(error):  # a second attempt could succeed, with the backends that are left
        return _fault("JAX", error)
    try:
        check()
    except InputError as fault:
        return str(fault)
    return ""


def _fault(library: str, error: Exception) -> str:
    reason, variables = one_line(error)[:300] or type(error).__name__, jax_setup.user_variables()
    advice = f"change or unset {variables}" if variables else "reinstall lgmdjax and its dependencies"
    return f"expected an environment in which {library} starts, got {reason}; {advice}"


def _start_jax() -> None:
    import jax
    import numpy as np

    np.asarray(jax.numpy.ones(2) + np.ones(2))  # both ways between host and device, which a variable may forbid


def _start_mujoco() -> None:
    import mujoco

    mujoco.MjModel.from_xml_string("<mujoco/>")


def _start_matplotlib() -> None:
    import matplotlib.rcsetup

    matplotlib.rcsetup.validate_backend(matplotlib.rcParams["backend"])


LIBRARIES: dict[str, Callable[[], None]] = {
    "JAX": _start_jax,
    "MuJoCo": _start_mujoco,
    "Matplotlib": _start_matplotlib,
}
