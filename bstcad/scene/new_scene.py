"""New scenes: a plate lens that projects a picture or letters with one of four lights, or a copy of a template."""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from bstcad.scene.errors import SceneError, nearest

if TYPE_CHECKING:
    from bstcad.scene.scene import Scene

SIZE = 80.0  # default size of a plate, mm
WIDTH_TO_THICKNESS = 10.0  # ratio of the longer side of a plate to its thickness
MIN_THICKNESS = 3.0  # mm; smallest thickness of a plate
RANGES = {"size": (1.0, 10_000.0), "distance": (1.0, 1e7)}  # ranges of the options --size and --distance, mm
BLUR_MARGIN = 1.1  # accept.rrmsd divided by the RRMSD of the blurred picture; standard designs stay below this limit
MIN_RRMSD, MAX_RRMSD = 0.05, 0.25  # smallest and largest accept.rrmsd of a new scene

LENGTH_UNITS = {"mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "µm": 1e-3, "um": 1e-3, "in": 25.4, "ft": 304.8}  # mm
LENGTH_WITH_UNIT = re.compile(rf"(.*\d\.?)\s*({'|'.join(LENGTH_UNITS)})", re.DOTALL)
LIKE_THE_PHOTO = re.compile(r"(?:([^xX×]+)[xX×])?photo")  # size with the photo's proportions: "photo" or "120xphoto"

TEMPLATE = Path(__file__).with_name("plate.toml.j2")
COMMENT_COLUMN = 32  # column at which comments begin after short lines
COMMENT_WIDTH = 118  # largest number of characters in a line of comment


@dataclass(frozen=True)
class PlateLight:
    """A light for which a plate is made; plate.toml.j2 contains its table [source]."""

    name: str  # value of the option --light
    of: str  # name of the light in sentences, such as "an LED"
    header: str  # description of the light, which stays true if the user changes lengths in the scene
    pixels: int = 256  # pixels along the longer side of the target
    size: float = 0.0  # size of the source: mm for a lamp, degrees for parallel light; 0: no blur
    square: bool = False  # True for a square chip, False for a disc
    ahead: float = 0.0  # distance from the lamp to the plate, in longer sides of the plate; 0: parallel light
    throw: float = 5.0  # default distance from the plate to the wall, in longer sides of the plate
    hint: str = ""  # advice for finer detail


_TABLES = tomllib.loads(Path(__file__).with_name("lights.toml").read_text(encoding="utf-8"))
LIGHTS = {
    name: PlateLight(name, **table) for name, table in _TABLES.items()
}  # lights by name; the first is the default


@dataclass(frozen=True)
class Plate:
    """A plate with the light before it and the wall behind it."""

    light: PlateLight
    width: float  # mm
    height: float  # mm
    distance: float  # distance from the plate to the wall, mm

    @classmethod
    def of(
        cls, light: str | None = None, size: str | float | None = None, distance: str | float | None = None
    ) -> Plate:
        """Return the plate for --light, --size and --distance; None: the default.  SceneError for a wrong value."""
        if light is not None and light not in LIGHTS:
            raise SceneError(f"--light {light}: no such light; {nearest(light, list(LIGHTS), 'give one of')}")
        chosen = LIGHTS[light or next(iter(LIGHTS))]
        sides = _lengths("size", SIZE if size is None else size, "80, or width x height, such as 80x60", 2)
        [length] = _lengths("distance", chosen.throw * max(sides) if distance is None else distance, "2000", 1)
        return cls(chosen, sides[0], sides[-1], length)

    @property
    def side(self) -> float:
        """Longer side of the plate (mm)."""
        return max(self.width, self.height)

    @property
    def thickness(self) -> float:
        """Thickness of the plate (mm), in steps of half a millimetre."""
        return max(MIN_THICKNESS, math.ceil(2 * self.side / WIDTH_TO_THICKNESS) / 2)

    @property
    def before(self) -> float:
        """Distance from the lamp to the plate (mm); 0 for parallel light."""
        return self.light.ahead * self.side

    @property
    def half_angle(self) -> float:
        """Half angle (degrees) of the lamp's light that meets the plate, up to its corners."""
        return round(math.degrees(math.atan(math.hypot(self.width, self.height) / 2 / self.before)), 1)

    @property
    def magnification(self) -> float:
        """Width of the picture / width of the plate; the picture is as wide as the shadow of the plate."""
        return 1 + self.distance / self.before if self.before else 1.0

    @property
    def pixel(self) -> float:
        """Side of a pixel on the wall (mm)."""
        return self.magnification * self.side / self.light.pixels

    def source_image(self, distance: float) -> float:
        """Return the width (mm) of the source's image at this distance L (mm) from the plate.

        It is s L / before for a lamp of size s, and 2 L tan(s / 2) for parallel light of full angle s.
        """
        if self.before:
            return self.light.size * distance / self.before
        return 2 * distance * math.tan(math.radians(self.light.size / 2))

    def detail(self, distance: float) -> float:
        """Return the width (mm) of the finest detail on a wall at this distance; see source_images.detail_width."""
        from bstcad.optics.trace.source_images import (
            detail_width,  # loads torch, which a list of the templates does not need
        )

        as_a_disc = math.sqrt(4 / 3) if self.light.square else 1.0
        return detail_width(as_a_disc * self.source_image(distance), self.pixel)

    def expectation(self, blurred: float | None = None) -> str:
        """Return sentences on the finest detail; blurred: RRMSD due to the source's image, None: no advice."""
        wide, detail = self.magnification * self.side, self.detail(self.distance)
        text = f"The finest detail on this wall is {detail:.2g} mm wide"
        if self.light.square:  # image of the default LED as a disc: 4.86 mm through the whole plate, 5.77 at its centre
            text += " behind the centre of the plate, and less beside it, where the chip is seen at an angle"
        text += f", 1/{wide / detail:.0f} of the picture's {wide:.4g} mm"
        if blurred is None:
            return f"{text}."
        nearer = self.light.throw * self.side
        if not self.before and nearer < self.distance:
            text += f"; on a wall at {nearer:g} mm it is {self.detail(nearer):.2g} mm (--distance {nearer:g})"
        elif self.light.hint:
            text += f"; {self.light.hint}"
        if blurred > MAX_RRMSD:
            text += f". The blur is too large for this picture, which it changes by an RRMSD of {blurred:.2g}"
        return f"{text}."

    def blur_rrmsd(self, scene: Scene) -> float | None:
        """Return the RRMSD of the scene's picture blurred by the source's image; None for a source without size."""
        from bstcad.optics.surfaces.outlines import Circle, Rectangle
        from bstcad.optics.trace.source_images import even_image

        if not self.light.size:
            return None
        wide = self.source_image(self.distance) / self.pixel
        image = Rectangle(wide, wide) if self.light.square else Circle(wide / 2)
        return even_image(image).deviation(scene.target.irradiance())

    def text(self, name: str, picture: Path | None = None, blurred: float | None = None) -> str:
        """Return the text of the file of scene `name`; picture: path (None: letters); blurred: as for `expectation`."""
        import jinja2  # slow to load, and not needed for a list of the templates

        text = jinja2.Template(
            TEMPLATE.read_text(encoding="utf-8"), trim_blocks=True, keep_trailing_newline=True
        ).render(
            plate=self,
            light=self.light,
            name=name,
            title=_toml_string(f"{name}, for {self.light.of}"),
            header=textwrap.wrap(self.light.header, COMMENT_WIDTH),
            picture=picture and _toml_string(picture.as_posix()),
            rrmsd=blurred and min(max(math.ceil(100 * BLUR_MARGIN * blurred) / 100, MIN_RRMSD), MAX_RRMSD),
            blurred=blurred,
        )
        return "\n".join(map(_align_comment, text.split("\n")))


@dataclass(frozen=True)
class Written:
    """A new scene file, and the sentences that the command prints."""

    path: Path
    sentences: str = ""  # sentences on the light and the finest detail; "" for a template


def new_scene(
    name: str, folder: Path, *, picture: Path | None = None, light: str | None = None, size: str | float | None = None,
    distance: str | float | None = None, template: str | None = None,
) -> Written:  # fmt: skip
    """Write NAME.toml to `folder`, a commented scene that loads; SceneError for an existing file.

    The scene is a plate with a picture as large as the plate's shadow on the wall, or a copy of a template.  light: a
    name of LIGHTS.  size: size of the plate (mm), a number or width x height such as "80x60"; "photo" or "120xphoto"
    takes the proportions of the picture.  distance: from plate to wall (mm).  picture: path, relative to `folder`;
    None: letters.  template: name of a template, without the other options.
    """
    from bstcad.scene.picture import photo_size, read_picture, safe_name  # slow to load

    name = name.removesuffix(".toml")
    if not name or safe_name(name) != name:
        raise SceneError(f"{name!r} cannot be the name of a scene; use letters, digits, '-' and '_', such as my-lens")
    path = folder / f"{name}.toml"
    if template is not None:
        if (picture, light, size, distance) != (None,) * 4:
            given = "a template has its own light, picture and sizes"
            raise SceneError(f"--template {template}: {given}; remove --template, or the other options")
        text = _template(template, name)
        _write_scene(path, text, _pictures(text))
        return Written(path)
    if picture is not None:
        picture = Path(os.path.expanduser(picture))
        if not (folder / picture).exists():
            raise SceneError(f"--picture {picture}: not found; give the path of a picture file")
        read_picture(folder / picture)  # raises an error before a file is written
    if (longer := LIKE_THE_PHOTO.fullmatch(str(size))) is not None:
        if picture is None:
            raise SceneError(f"--size {size}: needs a photo; give --picture FILE, or a size such as 80x60")
        [side] = _lengths("size", longer[1] or SIZE, "80", 1)
        size = in_proportions(side, photo_size(read_picture(folder / picture)))
    plate = Plate.of(light, size, distance)
    scene = _write_scene(path, plate.text(name, picture))
    if (blurred := plate.blur_rrmsd(scene)) is not None:
        path.write_text(plate.text(name, picture, blurred), encoding="utf-8")
    *others, last = (name for name in LIGHTS if name != plate.light.name)
    made = f"The plate is for {plate.light.of}; --light {', '.join(others)} or {last} chooses another light."
    words = 'The picture is the word "Hello"; change target.text in the file, or give --picture FILE.'
    of_picture = [words] if picture is None else scene.target.remarks()
    return Written(path, "\n".join([made, plate.expectation(blurred), *of_picture]))


def in_proportions(side: float, shown: tuple[int, int]) -> str:
    """Return the size of a plate, such as "80x53.3", with this longer side (mm) and width / height as in `shown`."""
    width, height = (max(side * each / max(shown), RANGES["size"][0]) for each in shown)
    return f"{width:.4g}x{height:.4g}"


def without_unit(words: str) -> tuple[str, float]:
    """Return (words without a unit of length at their end, length of this unit in mm); (words, 1.0) without a unit."""
    found = LENGTH_WITH_UNIT.fullmatch(words.strip())
    return (found[1], LENGTH_UNITS[found[2]]) if found else (words, 1.0)


def _lengths(name: str, given: str | float, example: str, count: int) -> list[float]:
    """Return the lengths (mm) in the value `given` of the option --name: up to `count` lengths, such as "80x60"."""
    words, unit = without_unit(str(given))
    try:
        found = [unit * float(length) for length in re.split("[xX×]", words)]
    except ValueError:
        found = []
    if not 0 < len(found) <= count:
        raise SceneError(f"--{name} {given}: is not a {name}; give a length in mm, such as {example}, or with its unit")
    low, high = RANGES[name]
    for length in found:
        if not low <= length <= high:
            raise SceneError(f"--{name} {length:g}: is not between {low:g} and {high:g} mm; choose one in between")
    return found


def _align_comment(line: str) -> str:
    """Return a line with its comment moved to COMMENT_COLUMN, or to two spaces after the keys of a longer line."""
    keys, mark, comment = line.rpartition(" # ")
    return f"{keys:{COMMENT_COLUMN - 2}}  # {comment}" if mark else line


def _toml_string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # JSON and TOML have one syntax for it


def templates() -> dict[str, str]:
    """Return the titles of the bundled templates by name."""
    paths = sorted((path for path in _folder().iterdir() if path.name.endswith(".toml")), key=lambda path: path.name)
    texts = {path.name.removesuffix(".toml"): path.read_text(encoding="utf-8") for path in paths}
    return {name: tomllib.loads(text)["title"] for name, text in texts.items()}


def _template(template: str, name: str) -> str:
    """Return the text of a template in which the scene has this name."""
    known = list(templates())
    if template not in known:
        raise SceneError(f"--template {template}: no such template; {nearest(template, known, 'the templates are')}")
    text = (_folder() / f"{template}.toml").read_text(encoding="utf-8")
    for before in (f"bstcad generate templates/{template}.toml", f'name = "{template}"', f"outputs/{template}"):
        text = text.replace(before, before.replace("templates/", "").replace(template, name))
    return text


def _pictures(text: str) -> dict[str, bytes]:
    """Return the contents, by name, of the files of the templates' folder that the text of a template names."""
    pictures = (path for path in _folder().iterdir() if path.name.endswith(".png"))
    return {path.name: path.read_bytes() for path in pictures if f'"{path.name}"' in text}


def _folder() -> Traversable:
    """Return the folder of the templates: in an installed package, or beside the package in the source tree."""
    package = resources.files("bstcad")
    return inside if (inside := package / "templates").is_dir() else package / ".." / "templates"


def _write_scene(path: Path, text: str, pictures: Mapping[str, bytes] = MappingProxyType({})) -> Scene:
    """Write a new file of a scene and its pictures, and load it; remove the new files if the scene does not load."""
    from bstcad.scene.scene import load

    contents = {path: text.encode("utf-8")} | {path.with_name(name): data for name, data in pictures.items()}
    made: list[Path] = []
    try:
        for each, data in contents.items():
            if each != path and each.is_file() and each.read_bytes() == data:
                continue  # an equal picture of an earlier copy
            with each.open("xb") as file:
                made.append(each)
                file.write(data)
        return load(path)
    except BaseException as error:
        for each in made:
            each.unlink(missing_ok=True)
        if isinstance(error, FileExistsError):
            kept = "the file exists already and is not changed"
            raise SceneError(f"{error.filename}: {kept}; give another name, or move the file") from None
        raise
