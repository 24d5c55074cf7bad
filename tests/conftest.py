"""What every test runs under: float64, checked shapes, a compilation cache that outlives the run."""

import os
from collections.abc import Iterator
from pathlib import Path

# Before JAX is imported anywhere, and as a variable: subprocesses of a test must find the same cache.
ROOT = Path(__file__).parent.parent
CACHE = os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")  # so that crowds are dealt out
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA calls its own tuning flags errors
# Most of the tests' time is compilation, of which XLA's older code generator needs a third less. What it makes is
# slower where much is drawn, but little is drawn here.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-shapes", action="store_true", help="do not check every annotated shape and type")


def pytest_configure(config: pytest.Config) -> None:
    """Put the check of shapes in place before any test imports the package."""
    if not config.getoption("--no-shapes"):
        jaxtyping.install_import_hook("lgmdjax", "shapecheck.check")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the files that have slow tests, so that no worker is left alone with one at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Let arguments of a wrong type through to the package, which refuses them in its own words."""
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
