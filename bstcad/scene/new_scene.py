"""Scenes to start from: a plate in parallel light with a picture or letters, and the templates that come along."""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from bstcad.scene.errors import SceneError, nearest

SIZE = 80.0  # mm, of a plate
THROW = 5.0  # plates: how far the wall is if nobody says
SLIM = 10.0  # a plate is so many times as wide as thick …
LEAST = 3.0  # … but at least so thick (mm)
RANGES = {"size": (1.0, 10_000.0), "distance": (1.0, 1e7)}  # mm

COLUMN = 32  # of a line's comment, where the line is not longer

PLATE = """\
# A plate in parallel light that throws {what} on a wall: change a line, then run
#
#     bstcad generate {name}.toml
#
# Lengths are in mm, angles in degrees, wavelengths in nm.  Light travels along +z, and y is up.

name = "{name}" # the design goes to outputs/{name}
title = {title} # one line, for the report

[source]
kind = "collimated" # parallel light, as the sun's; of a lamp it is "point": --template disk
wavelength = 587.6 # nm: yellow, in the middle of white light; or lines: [[486.1, 1.0], [656.3, 1.0]]
# divergence = 0.53 # degrees: as wide as the sun looks, whose light makes the picture softer
aperture = {{ shape = "rectangle", width = {size}, height = {size} }} # the beam, as wide as the plate
profile = "uniform" # the same irradiance everywhere in it; or "gaussian" with radius_1e2 = …

[lens]
material = "PMMA" # acrylic; or "PC", "N-BK7" …, any page of refractiveindex.info, or index = 1.49
outline = {{ shape = "rectangle", width = {size}, height = {size} }} # or {{ shape = "circle", diameter = {size} }}
front = {{ kind = "plane", z = 0.0 }} # the flat face, where the light enters
back = {{ kind = "bspline", z = {thickness}, control_points = 513 }} # the face bstcad finds, flat before

[target]
z = {z} # the wall, {distance} mm behind the plate
x = [{low}, {high}] # as wide as the plate, on its axis
y = [{low}, {high}]
pixels = 512 # along each side
{picture}
seen_from = "lens" # upright and unmirrored for a person at the plate who looks at the wall;
# seen_from = "behind" # … for a person behind a translucent screen who looks at the plate

[tailoring]
quality = "standard" # draft | standard | fine: more time, less error
# max_time = 60.0 # s, from the command to the report: the best that fits

[tolerances]  # what the report holds the lens to
min_thickness = {thinnest} # mm, everywhere
# rrmsd = 0.1 # relative RMS deviation of the irradiance from the picture
"""
IMAGE = """\
image = {path} # relative to this file; or text = "…", a sample, uniform = true
fit = "crop" # of a picture of other proportions; or "pad", "stretch"
# gamma = 1.0 # for a file that holds light itself; else a photo is read as a screen shows it"""
TEXT = """\
text = "Hello" # or image = "photo.jpg" (relative to this file), a sample, uniform = true"""


def new_scene(
    name: str,
    folder: Path,
    *,
    picture: Path | None = None,
    size: float | None = None,
    distance: float | None = None,
    template: str | None = None,
) -> Path:
    """Write NAME.toml to `folder`, a commented scene that loads; never over another file.  SceneError.

    A plate of size x size mm, a picture as large, at that distance; or a copy of a template.  The path of the picture
    is relative to the folder.
    """
    from bstcad.scene.picture import (  # loads much, which a list of the templates need not wait for
        read_picture,
        safe_name,
    )

    name = name.removesuffix(".toml")
    if not name or safe_name(name) != name:
        raise SceneError(f"{name!r} is no name for a scene; give one of letters, digits, '-' and '_', such as my-lens")
    path = folder / f"{name}.toml"
    if template is not None:
        if (picture, size, distance) != (None, None, None):
            raise SceneError(f"--template {template}: has a picture and sizes of its own; give either it or them")
        text = renamed(_template(template).read_text(encoding="utf-8"), name)
    else:
        if picture is not None:
            picture = Path(os.path.expanduser(picture))
            read_picture(folder / picture)  # before anything is written
        text = plate(name, picture, size, distance)
    return _written(path, text)


def plate(name: str, picture: Path | None = None, size: float | None = None, distance: float | None = None) -> str:
    """The scene file of a plate in parallel light, with the picture of that path or else with letters."""
    size = _in_range("size", SIZE if size is None else size)
    distance = _in_range("distance", THROW * size if distance is None else distance)
    thickness = max(LEAST, math.ceil(2 * size / SLIM) / 2)  # to half a millimetre
    image = None if picture is None else IMAGE.format(path=_quoted(picture.as_posix()))
    text = PLATE.format(
        name=name,
        what="letters" if image is None else "a picture",
        title=_quoted(f"{name}, in parallel light"),
        size=_number(size),
        thickness=_number(thickness),
        thinnest=_number(thickness / 4),
        z=_number(thickness + distance),
        distance=f"{distance:g}",
        low=_number(-size / 2),
        high=_number(size / 2),
        picture=image or TEXT,
    )
    return "\n".join(map(_aligned, text.split("\n")))


def _aligned(line: str) -> str:
    """A line with its comment in the column of comments, or two blanks behind what is longer."""
    said, mark, comment = line.rpartition(" # ")
    return f"{said:{COLUMN - 2}}  # {comment}" if mark else line


def templates() -> dict[str, str]:
    """The templates that come along, by name, with their titles."""
    found = sorted(_folder().iterdir(), key=lambda path: path.name)
    texts = {path.name: path.read_text(encoding="utf-8") for path in found if path.name.endswith(".toml")}
    return {name.removesuffix(".toml"): tomllib.loads(text)["title"] for name, text in texts.items()}


def renamed(text: str, name: str) -> str:
    """A template's text, for a scene of another name."""
    [old] = re.findall(r'^name = "([\w-]+)"', text, re.M)
    return (
        text.replace(f"bstcad generate templates/{old}.toml", f"bstcad generate {name}.toml")
        .replace(f'name = "{old}"', f'name = "{name}"', 1)
        .replace(f"outputs/{old}", f"outputs/{name}")
    )


def _template(name: str) -> Traversable:
    known = list(templates())
    if name not in known:
        raise SceneError(f"--template {name}: is none; {nearest(name, known, 'there are')}")
    return _folder() / f"{name}.toml"


def _folder() -> Traversable:
    """In the package once that is installed, beside it in the source tree."""
    package = resources.files("bstcad")
    return inside if (inside := package / "templates").is_dir() else package / ".." / "templates"


def _written(path: Path, text: str) -> Path:
    """Put a scene where there is no file, if it loads."""
    from bstcad.scene.scene import load

    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise SceneError(f"{path}: is there already and stays as it is; give another name") from None
    try:
        load(path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return path


def _in_range(name: str, value: float) -> float:
    least, most = RANGES[name]
    if not least <= value <= most:
        raise SceneError(f"--{name} {value:g}: is not between {least:g} and {most:g} mm; choose one in between")
    return value


def _number(value: float) -> str:
    return repr(float(value))


def _quoted(text: str) -> str:
    """As a TOML string, which JSON's is too."""
    return json.dumps(text, ensure_ascii=False)
