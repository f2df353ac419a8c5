"""Runs the blocks of the tutorials when the site is built; their output and pictures stand in the pages."""

from __future__ import annotations

import shutil
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import code_blocks
import skimage.data
import skimage.io
from gallery_pictures import fitting
from PIL import Image
from sphinx.util import logging

DOCS = Path(__file__).parents[1]
MADE = DOCS / "_made"
HEAVY = 400_000  # bytes; heavier pictures are brought to the size of the gallery's
BEFORE, BEHIND = 100, 900  # priorities: the gallery runs with 500, in Sphinx's own process


class Runs:
    """The tutorials, run one after the other beside the gallery."""

    def __init__(self) -> None:
        self.pool = ThreadPoolExecutor(1)
        self.ended: Future[None] | None = None

    def begin(self, app: Any) -> None:
        """Start with the first of them."""
        self.ended = self.pool.submit(make)

    def end(self, app: Any) -> None:
        """Wait for the last, and pass on the error of one that failed."""
        assert self.ended is not None
        self.ended.result()
        self.pool.shutdown()


PAGES = sorted(set((DOCS / "tutorials").glob("*.md")) - {DOCS / "tutorials" / "index.md"})  # the tutorials


def follow(page: Path, folder: Path) -> None:
    """Run the blocks of a tutorial in a new folder, beside the templates and a photograph; an error is raised."""
    shutil.copytree(DOCS.parent / "templates", folder / "templates")
    skimage.io.imsave(folder / "photo.jpg", skimage.data.astronaut()[:512, 32:480])
    code_blocks.run(page, folder)


def make() -> None:
    """Run each tutorial in a folder of its own, docs/_made/NAME."""
    for page in PAGES:
        folder = MADE / page.stem
        shutil.rmtree(folder, ignore_errors=True)  # files of the build before: `bstcad new` overwrites no scene
        logging.getLogger(__name__).info("running %s", page.name)
        follow(page, folder)
        for path in folder.glob("*.png"):
            if path.stat().st_size > HEAVY:
                fitting(Image.open(path)).save(path, optimize=True)


def setup(app: Any) -> dict[str, bool]:
    """Sphinx calls it."""
    runs = Runs()
    app.connect("builder-inited", runs.begin, priority=BEFORE)
    app.connect("builder-inited", runs.end, priority=BEHIND)
    return {"parallel_read_safe": True}
