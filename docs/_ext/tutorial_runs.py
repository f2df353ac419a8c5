"""Runs the blocks of the tutorials when the site is built; their output and pictures stand in the pages."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import code_blocks
import skimage.data
import skimage.io
from sphinx.util import logging

DOCS = Path(__file__).parents[1]
MADE = DOCS / "_made"


def make(app: Any) -> None:
    """Run each tutorial in a folder of its own, docs/_made/NAME, beside the templates and a photograph."""
    for page in sorted(set((DOCS / "tutorials").glob("*.md")) - {DOCS / "tutorials" / "index.md"}):
        folder = MADE / page.stem
        shutil.copytree(DOCS.parent / "templates", folder / "templates", dirs_exist_ok=True)
        skimage.io.imsave(folder / "photo.jpg", skimage.data.astronaut()[:512, 32:480])
        logging.getLogger(__name__).info("running %s", page.name)
        code_blocks.run(page, folder)


def setup(app: Any) -> dict[str, bool]:
    """Sphinx calls it."""
    app.connect("builder-inited", make)
    return {"parallel_read_safe": True}
