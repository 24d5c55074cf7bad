"""Settings of all tests: double precision, checked shapes, a compilation cache that outlives the run.

Set LGMDJAX_TEST_DEFAULT_XLA=1 to compile with XLA's default flags, as users do. `make test` does so for the tests that
are marked `default_xla`, and runs the others without it: with XLA's older code generator and, unless they are marked
`optimised`, with few optimisations, so that they compile in half the time.
"""

import os
from collections.abc import Iterator
from pathlib import Path

from lgmdjax.runtime.jax_setup import collect_garbage_rarely, prepare_opengl

# As variables, and before JAX is imported anywhere: processes that a test starts must find the same cache.
ROOT = Path(__file__).parent.parent
CACHE = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")  # so that robots are sharded
os.environ.setdefault("MPLBACKEND", "Agg")
prepare_opengl()
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA logs its own tuning flags as errors
# Of small programs too, which every process would compile again.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
DEFAULT_XLA = os.environ.get("LGMDJAX_TEST_DEFAULT_XLA") == "1"
if not DEFAULT_XLA:
    # Most of the tests' time is compilation, which takes a third less with XLA's older code generator. Its programs
    # render images more slowly, but tests render few.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
# Tests that run with the default flags, as whole files, so that no program is compiled with both: contracts,
# derivatives, images, detectors, the closed loop with its mirror symmetry, and the robot's behaviour. Gradients through
# body and eyes take longer to compile so than all of these.
DEFAULT_XLA_FILES = (
    "test_contract.py",
    "test_gradients.py",
    "test_camera.py",
    "test_laser.py",
    "test_lgmd.py",
    "test_closed_loop.py",
    "test_behaviour.py",
    "test_conftest.py",
)
# Files that use the programs of the smoke run, so they come after it.
AFTER_SMOKE_RUN = ("test_run_trial.py", "test_studies_small.py", "test_docs.py", "test_notebooks.py")

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", CACHE)
collect_garbage_rarely()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-shapes", action="store_true", help="do not check every annotated shape and type")


def pytest_configure(config: pytest.Config) -> None:
    """Install the check of shapes before any test imports the package."""
    if not config.getoption("--no-shapes"):
        jaxtyping.install_import_hook("lgmdjax", "shapecheck.check")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Where only the files for the default flags are asked for, do not import the others in every process."""
    is_other = collection_path.suffix == ".py" and collection_path.name not in DEFAULT_XLA_FILES
    return True if is_other and str(config.getoption("markexpr")).startswith("default_xla") else None


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One process more than cores: a process is idle while it waits for another, a file or a clock."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(tryfirst=True)  # before -m selects by marker
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests for XLA's default flags; order files by how long they take, so that no slow one is left at the end."""
    for item in items:
        if item.path.name in DEFAULT_XLA_FILES:
            item.add_marker("default_xla")
    slow = {item.path for item in items if item.get_closest_marker("slow")}

    def rank(item: pytest.Item) -> int:
        if item.path.name == "test_stages.py":
            return 0
        if item.path.name in AFTER_SMOKE_RUN:
            return 2
        return 1 if item.path in slow else 3

    items.sort(key=rank)


@pytest.fixture(scope="module", autouse=True)
def few_optimisations(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile with few optimisations: most tests run too briefly to profit from more. Marked files get them all."""
    is_marked = request.node.get_closest_marker("optimised") is not None
    is_optimised = DEFAULT_XLA or is_marked or request.path.name in DEFAULT_XLA_FILES
    jax.config.update("jax_disable_most_optimizations", not is_optimised)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Turn the check of shapes and types off, so that the package's own checks see wrong arguments."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def strict() -> Iterator[None]:
    """Forbid implicit dtype promotion: an array of integers may not meet one of floats without a cast."""
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(params=["float64", "float32"])
def precision(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the test twice, in double and in single precision; the value is the name of the dtype."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param


@pytest.fixture
def float32() -> Iterator[None]:
    """Run the test in single precision, as a user does by default."""
    with jax.enable_x64(False):
        yield
