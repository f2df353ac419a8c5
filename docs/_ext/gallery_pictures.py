"""Pictures of the gallery: each PNG that a block of a script wrote below outputs/, with its light first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image

WIDEST, NARROWEST = 1000, 480  # pixels of a picture in the page
# Names of the pictures that the page shows, in this order; wall_2 and irradiance_2 are those of a second target.
SHOWN = ("wall", "light", "irradiance", "wavefront", "lens", "part")


def pictures(block: Any, variables: dict[str, Any], configuration: dict[str, Any]) -> str:
    """The pictures that the block wrote, as reStructuredText; sphinx-gallery calls it after each block."""
    from sphinx_gallery.scrapers import figure_rst  # which a test of the names need not have

    script = Path(variables["src_file"])
    shown = variables["example_globals"].setdefault("_shown", set())
    new = [path for path in written(script.parent / "outputs" / script.stem) if path not in shown]
    paths = []
    for path in new:
        shown.add(path)
        paths.append(next(variables["image_path_iterator"]))
        fitting(Image.open(path)).save(paths[-1], optimize=True)
    return figure_rst(paths, configuration["src_dir"]) if paths else ""


def written(folder: Path) -> list[Path]:
    """The pictures in a folder and below that the page shows, in its order."""
    return [
        path for name in SHOWN for pattern in (f"{name}.png", f"{name}_[0-9].png")
        for path in sorted(folder.rglob(pattern))
    ]  # fmt: skip


def fitting(picture: Image.Image) -> Image.Image:
    """A picture as wide as a page takes it, in 256 colours; the pixels of a target stay squares."""
    times = -(-NARROWEST // picture.width)
    if times > 1:
        return picture.resize((times * picture.width, times * picture.height), Image.Resampling.NEAREST)
    if picture.width > WIDEST:
        size = WIDEST, round(picture.height * WIDEST / picture.width)
        picture = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    return picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
