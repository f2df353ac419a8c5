"""Puts the documentation into a wheel, for `bstcad docs`: as bstcad/site if it has been built, else its Markdown."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Documentation(BuildHookInterface):
    """Includes docs/_build/html, if `make docs` has built it, else the Markdown as bstcad/manual."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Before the wheel is put together; an editable install finds the pages where they were built."""
        site = Path(self.root) / "docs" / "_build" / "html"
        if version == "standard" and (site / "index.html").is_file():
            build_data["force_include"][str(site)] = "bstcad/site"
        elif version == "standard":
            docs = Path(self.root) / "docs"
            for page in docs.rglob("*.md"):
                build_data["force_include"][str(page)] = f"bstcad/manual/{page.relative_to(docs).as_posix()}"
