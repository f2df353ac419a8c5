"""A workbench that runs, as the command starts it, and pages in Chromium."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = (
    "--no-sandbox", "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
START = 120.0  # seconds
SEEN, PATIENCE = ".light-on-wall", 120_000  # a preview on a page; milliseconds, on a busy machine
SMALL = """\
# An evenly lit disc, small enough for a test: every comment stays
name = "small"  # of the folder

[source]
kind = "collimated"
aperture = { shape = "circle", radius = 6.0 }  # mm

[lens]
material = "PMMA"
outline = { shape = "circle", diameter = 12.0 }
front = { kind = "plane", z = 0.0 }
back = { kind = "bspline", z = 4.0, control_points = 65 }

[target]
z = 100.0
x = [-8.0, 8.0]
y = [-8.0, 8.0]
pixels = 48
uniform = true
outline = { shape = "circle", radius = 7.5 }

[tailoring]
quality = "draft"
rays = 160
"""


# The command line in a process: previews of small nets and few tubes, and predictions without pilots.
QUICK_PREVIEWS = """
from dataclasses import replace
from functools import partial
from bstcad.app import server
from bstcad.app.preview_desk import PreviewDesk
from bstcad.cli import main
from bstcad.planning.reduction import QUICK
from tests.planning.conftest import typical_pilot
few = replace(QUICK, net=33, tubes=64, rounds=1, evaluations=3, blurred=2)
more = replace(QUICK, net=49, tubes=96, rounds=1, evaluations=4, blurred=2)
server.serve = partial(server.serve, desk=PreviewDesk((few, more), typical_pilot))
main()
"""


@dataclass
class Served:
    """A workbench in a process of its own."""

    folder: Path
    process: subprocess.Popen
    address: str  # URL of the workbench, with the token

    @property
    def root(self) -> str:
        return self.address.partition("?")[0].rstrip("/")

    def end(self, number: int = signal.SIGINT) -> str:
        """End it by a signal; what it said."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        said, _ = self.process.communicate(timeout=START)
        return said


def begin(folder: Path, *arguments: str, quick: bool = True) -> Served:
    """bstcad app in a folder, once it answers; quick: with QUICK_PREVIEWS."""
    program = ["-c", QUICK_PREVIEWS] if quick else ["-m", "bstcad.cli"]
    command = [sys.executable, *program, "app", str(folder), "--no-browser", *arguments]
    source = str(Path(__file__).parents[2])
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder,
        env=os.environ | {"PYTHONPATH": source},
    )  # fmt: skip
    line = process.stdout.readline()
    assert line.startswith("Workbench: http://127.0.0.1:"), line + process.stdout.read()
    return Served(folder, process, line.split()[1])


@pytest.fixture
def served(tmp_path):
    """A workbench of one test, in a folder of its own with the scene small.toml."""
    (tmp_path / "small.toml").write_text(SMALL, encoding="utf-8")
    own = begin(tmp_path)
    yield own
    with contextlib.suppress(subprocess.TimeoutExpired):
        own.end()


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A workbench of all tests of a file."""
    folder = tmp_path_factory.mktemp("workbench")
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    own = begin(folder)
    yield own
    own.end()


@contextlib.contextmanager
def launched():
    """Chromium without a window, as the system has it."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here; on Debian: sudo apt install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as found:
        browser = found.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def chromium():
    """Chromium of all tests of a file."""
    with launched() as browser:
        yield browser


def open_scene(page, own: Served, name: str) -> Path:
    """Open the page of the small scene under another name, until it shows a preview; the scene's file."""
    path = own.folder / f"{name}.toml"
    path.write_text(SMALL.replace('"small"', f'"{name}"'), encoding="utf-8")
    page.goto(f"{own.root}/scene/{name}")
    page.wait_for_selector(SEEN, timeout=PATIENCE)
    return path


class Faults(list):
    """Complaints of a page: errors of its script, and requests to other hosts."""


@pytest.fixture
def open_page(chromium):
    """A function that opens an address in a window of its own, which ends with the test; no page may complain."""
    contexts, faults = [], Faults()

    def opened(address: str, **options):
        context = chromium.new_context(**{"viewport": {"width": 1360, "height": 900}, **options})
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(f"script: {error}"))
        page.on("request", lambda request: _elsewhere(request.url, address, faults))
        page.goto(address)
        return page

    opened.faults = faults
    yield opened
    for context in contexts:
        context.close()
    assert faults == []


def _elsewhere(url: str, address: str, faults: list[str]) -> None:
    host = address.split("/")[2]
    if not url.startswith((f"http://{host}/", "data:", "blob:", "about:")):
        faults.append(f"asks elsewhere: {url}")
