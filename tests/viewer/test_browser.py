"""`lgmdjax demo` and a walk's page in a real browser: they load without errors, move, and react."""

import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import synthetic
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By

from lgmdjax.reporting import walk_page

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
if not (CHROMIUM and DRIVER):
    pytest.skip("needs chromium and chromedriver (Debian: chromium, chromium-driver)", allow_module_level=True)

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--window-size=900,420",
)
PATIENCE = 90.0  # s; on a machine that is busy, software WebGL takes long


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def demo() -> Iterator[tuple[subprocess.Popen, str]]:
    words = [sys.executable, "-m", "lgmdjax", "demo", "--port", "0", "--no-browser"]
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background job ignores it
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    address = re.search(r"http://127\.0\.0\.1:\d+", line)
    assert address is not None, process.communicate()[1]
    yield process, address[0]
    process.kill()


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Wait for a condition."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited {PATIENCE:g} s until {what}"
        time.sleep(0.3)


def errors(browser: webdriver.Chrome) -> list[str]:
    return [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]


def seconds(browser: webdriver.Chrome) -> float:
    """Return the time of the walk that the page shows."""
    text = browser.execute_script("return document.body.innerText")
    found = re.search(r"t = ([\d.]+) s", text)
    return float(found[1]) if found else -1.0


def press(browser: webdriver.Chrome, label: str) -> None:
    """Press the button with this label."""
    wait_until(
        lambda: browser.execute_script(
            "const b = [...document.querySelectorAll('button')].find(b => b.innerText.trim() == arguments[0]);"
            "if (b) b.click(); return Boolean(b)",
            label,
        ),
        f"there is a button {label}",
    )


def test_the_demo_moves_pauses_and_steps(browser, demo):
    browser.get(demo[1])
    wait_until(lambda: seconds(browser) > 0, "the page shows the time")
    begin = seconds(browser)
    wait_until(lambda: seconds(browser) not in (-1, begin), "the robot moves")
    press(browser, "Pause")
    wait_until(lambda: "Play" in browser.execute_script("return document.body.innerText"), "it pauses")
    time.sleep(1)
    paused = seconds(browser)
    time.sleep(1)
    assert seconds(browser) == paused
    press(browser, "+1 s")
    wait_until(lambda: seconds(browser) != paused, "it steps")
    assert (seconds(browser) - paused) % 40 == pytest.approx(1.0, abs=0.05)
    text = browser.execute_script("return document.body.innerText")
    assert all(name in text for name in ("Both eyes", "Layers of both LGMDs", "LGMD outputs u", "Live"))
    assert browser.find_elements(By.TAG_NAME, "canvas")
    pictures = "return [...document.querySelectorAll('img')].filter(i => i.naturalWidth > 100).length"
    assert browser.execute_script(pictures) >= 2
    assert not errors(browser)


def test_a_page_of_a_walk_loads_without_a_server(browser, tmp_path: Path):
    path = walk_page.walk_page(synthetic.walk(1, 60), synthetic.room(), seconds=2.0).write(tmp_path / "walk.html")
    browser.get(path.as_uri())
    wait_until(lambda: len(browser.find_elements(By.TAG_NAME, "button")) >= 2, "there are controls")
    assert browser.find_elements(By.TAG_NAME, "canvas")
    assert not errors(browser)


def test_ctrl_c_ends_the_demo(demo):
    process, _ = demo
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130
    assert stderr.strip() == "lgmdjax: interrupted; the same command starts again"
