"""The lock file: every package has one version and hashes, and everything that installs from it requires them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
INSTALLERS = ("Makefile", ".github/workflows/ci.yml")


@pytest.fixture(scope="module")
def packages() -> list[str]:
    text = (ROOT / "requirements.lock").read_text().replace("\\\n", " ")
    return [line for line in text.splitlines() if line.strip() and not line.startswith("#")]


def test_every_package_has_a_version_and_hashes(packages: list[str]) -> None:
    assert len(packages) > 50
    for package in packages:
        assert re.match(r"[A-Za-z0-9._-]+(\[[\w,-]+\])?==\S+", package), package
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", package), package
        assert "://" not in package


@pytest.mark.parametrize("name", INSTALLERS)
def test_hashes_are_required(name: str) -> None:
    lines = [
        line for line in (ROOT / name).read_text().splitlines() if re.search(r"(-r|--requirement) requirements", line)
    ]
    assert lines and all("--require-hashes" in line for line in lines)
