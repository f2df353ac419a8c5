"""Scenes to start from: a plate that throws a picture or letters by one of four lights, and the templates."""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
import tomllib
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING

from bstcad.scene.errors import SceneError, nearest

if TYPE_CHECKING:
    from bstcad.scene.scene import Scene

SIZE = 80.0  # mm, of a plate
SLIM = 10.0  # a plate is so many times as wide as thick …
LEAST = 3.0  # … but at least so thick (mm)
RANGES = {"size": (1.0, 10_000.0), "distance": (1.0, 1e7)}  # mm
OVER_BLUR = 1.1  # times the RRMSD of the blurred picture: standard quality ends well below that, a draft hardly
FEWEST_RRMSD, MOST_RRMSD = 0.05, 0.25  # the smallest and the largest limit that is written

LIKE_THE_PHOTO = re.compile(r"(?:([^xX×]+)[xX×])?photo")  # a size: the longer side, or SIZE, by the photo's other side

TEMPLATE = Path(__file__).with_name("plate.toml.j2")
COLUMN = 32  # of a line's comment, where the line is not longer
WIDTH = 118  # of a comment


@dataclass(frozen=True)
class Light:
    """A light to make a plate for; its table [source] stands in plate.toml.j2."""

    name: str  # the word of the option --light
    of: str
    header: str  # which light that is, in sentences that stay true where the scene's lengths are changed
    pixels: int = 256
    size: float = 0.0  # mm of a lamp, degrees of parallel light; 0: the picture is as sharp as its pixels
    square: bool = False  # a chip; else a disc
    ahead: float = 0.0  # plates: how far before the plate a lamp is; 0: its light is parallel
    throw: float = 5.0  # plates: how far the wall is by default; the sun's image grows with the distance
    hint: str = ""  # how detail would be finer


_TABLES = tomllib.loads(Path(__file__).with_name("lights.toml").read_text(encoding="utf-8"))
LIGHTS = {name: Light(name, **table) for name, table in _TABLES.items()}  # the first is the default


@dataclass(frozen=True)
class Plate:
    """A plate, the wall behind it and the light before it (mm)."""

    light: Light
    width: float
    height: float
    distance: float

    @classmethod
    def of(
        cls, light: str | None = None, size: str | float | None = None, distance: str | float | None = None
    ) -> Plate:
        """The plate that a user describes; None: the default.  SceneError."""
        if light is not None and light not in LIGHTS:
            raise SceneError(f"--light {light}: is none; {nearest(light, list(LIGHTS), 'give one of')}")
        chosen = LIGHTS[light or next(iter(LIGHTS))]
        sides = _lengths("size", SIZE if size is None else size, "80, or width x height, such as 80x60", 2)
        [far] = _lengths("distance", chosen.throw * max(sides) if distance is None else distance, "2000", 1)
        return cls(chosen, sides[0], sides[-1], far)

    @property
    def side(self) -> float:
        """The longer side."""
        return max(self.width, self.height)

    @property
    def thickness(self) -> float:
        """To half a millimetre."""
        return max(LEAST, math.ceil(2 * self.side / SLIM) / 2)

    @property
    def before(self) -> float:
        """From the lamp to the plate; 0 of parallel light."""
        return self.light.ahead * self.side

    @property
    def magnified(self) -> float:
        """Times the plate: as wide is the picture, and as its shadow."""
        return 1 + self.distance / self.before if self.before else 1.0

    @property
    def pixel(self) -> float:
        """The side of a pixel."""
        return self.magnified * self.side / self.light.pixels

    def source_image(self, distance: float) -> float:
        """The side of the source's image on a wall so far away: 2 L tan(δ / 2), or d L / l from l before the plate."""
        if self.before:
            return self.light.size * distance / self.before
        return 2 * distance * math.tan(math.radians(self.light.size / 2))

    def detail(self, distance: float) -> float:
        """The width of the finest detail on a wall so far away (optics.measure.detail_width)."""
        from bstcad.optics.measure import detail_width  # loads torch, which a list of the templates need not

        as_a_disc = math.sqrt(4 / 3) if self.light.square else 1.0
        return detail_width(as_a_disc * self.source_image(distance), self.pixel)

    def expectation(self, blurred: float | None = None) -> str:
        """Which detail survives, in a sentence; blurred: RRMSD of the picture by the source's image alone."""
        wide, detail = self.magnified * self.side, self.detail(self.distance)
        text = f"The finest detail on this wall is {detail:.2g} mm wide"
        if self.light.square:  # bstcad plan traces 4.86 mm through the whole plate where its middle has 5.77
            text += " behind the middle of the plate, finer beside it, where the chip is seen at a slant"
        text += f", 1/{wide / detail:.0f} of the picture's {wide:.4g} mm"
        if blurred is None:
            return f"{text}."
        nearer = self.light.throw * self.side
        if not self.before and nearer < self.distance:
            text += f"; on a wall at {nearer:g} mm it is {self.detail(nearer):.2g} mm (--distance {nearer:g})"
        elif self.light.hint:
            text += f"; {self.light.hint}"
        if blurred > MOST_RRMSD:
            text += f". That is too coarse for this picture, which it changes by an RRMSD of {blurred:.2g}"
        return f"{text}."

    def blurred(self, scene: Scene) -> float | None:
        """RRMSD of the scene's picture blurred by the source's image alone; None: the source has no size."""
        from bstcad.optics.measure import even_image
        from bstcad.optics.outlines import Circle, Rectangle

        if not self.light.size:
            return None
        wide = self.source_image(self.distance) / self.pixel
        image = Rectangle(wide, wide) if self.light.square else Circle(wide / 2)
        return even_image(image).deviation(scene.target.irradiance())

    def text(self, name: str, picture: Path | None = None, blurred: float | None = None) -> str:
        """The scene file, with the picture of that path or else with letters."""
        import jinja2  # which a list of the templates need not wait for

        text = jinja2.Template(
            TEMPLATE.read_text(encoding="utf-8"), trim_blocks=True, keep_trailing_newline=True
        ).render(
            plate=self,
            light=self.light,
            name=name,
            title=_quoted(f"{name}, for {self.light.of}"),
            header=textwrap.wrap(self.light.header, WIDTH),
            picture=picture and _quoted(picture.as_posix()),
            rrmsd=blurred and min(max(math.ceil(100 * OVER_BLUR * blurred) / 100, FEWEST_RRMSD), MOST_RRMSD),
            blurred=blurred,
        )
        return "\n".join(map(_aligned, text.split("\n")))


@dataclass(frozen=True)
class Written:
    """A new scene file."""

    path: Path
    sentences: str = ""  # on the light and on the detail that it leaves; "" of a template


def new_scene(
    name: str, folder: Path, *, picture: Path | None = None, light: str | None = None, size: str | float | None = None,
    distance: str | float | None = None, template: str | None = None,
) -> Written:  # fmt: skip
    """Write NAME.toml to `folder`, a commented scene that loads; never over another file.  SceneError.

    A plate of that size (mm; one number, "80x60", width by height, or in the picture's proportions "photo" or
    "120xphoto"), a picture as large as the plate's shadow on a wall at that distance, by that light (LIGHTS); or a copy
    of a template.  The path of the picture is relative to the
    folder.
    """
    from bstcad.scene.picture import photo_size, read_picture, safe_name  # loads much, unlike a list of the templates

    name = name.removesuffix(".toml")
    if not name or safe_name(name) != name:
        raise SceneError(f"{name!r} is no name for a scene; give one of letters, digits, '-' and '_', such as my-lens")
    path = folder / f"{name}.toml"
    if template is not None:
        if (picture, light, size, distance) != (None,) * 4:
            given = "has a light, a picture and sizes of its own"
            raise SceneError(f"--template {template}: {given}; give either it or them")
        _written(path, _template(template, name))
        return Written(path)
    if picture is not None:
        picture = Path(os.path.expanduser(picture))
        if not (folder / picture).exists():
            raise SceneError(f"--picture {picture}: not found; give the path of a picture file")
        read_picture(folder / picture)  # before anything is written
    if (longer := LIKE_THE_PHOTO.fullmatch(str(size))) is not None:
        if picture is None:
            raise SceneError(f"--size {size}: there is no photo; give --picture FILE, or a size such as 80x60")
        [side] = _lengths("size", longer[1] or SIZE, "80", 1)
        size = in_proportions(side, photo_size(read_picture(folder / picture)))
    plate = Plate.of(light, size, distance)
    scene = _written(path, plate.text(name, picture))
    if (blurred := plate.blurred(scene)) is not None:
        path.write_text(plate.text(name, picture, blurred), encoding="utf-8")
    *others, last = (name for name in LIGHTS if name != plate.light.name)
    made = f"A plate for {plate.light.of}; --light {', '.join(others)} or {last} makes it for another light."
    words = 'The picture is the word "Hello"; target.text in the file has it, --picture FILE another.'
    of_picture = [words] if picture is None else scene.target.remarks()
    return Written(path, "\n".join([made, plate.expectation(blurred), *of_picture]))


def in_proportions(side: float, shown: tuple[int, int]) -> str:
    """Return the size of a plate with a picture's proportions (width, height) and the longer side (mm): "80x53.3"."""
    width, height = (max(side * each / max(shown), RANGES["size"][0]) for each in shown)
    return f"{width:.4g}x{height:.4g}"


def _lengths(name: str, given: str | float, such_as: str, most: int) -> list[float]:
    """The lengths (mm) that an option gives, at most so many, with x between: 80 or "80x60"."""
    try:
        found = [float(length) for length in re.split("[xX×]", str(given))]
    except ValueError:
        found = []
    if not 0 < len(found) <= most:
        raise SceneError(f"--{name} {given}: is no {name}; give mm, such as {such_as}")
    low, high = RANGES[name]
    for length in found:
        if not low <= length <= high:
            raise SceneError(f"--{name} {length:g}: is not between {low:g} and {high:g} mm; choose one in between")
    return found


def _aligned(line: str) -> str:
    """A line with its comment in the column of comments, or two blanks behind what is longer."""
    keys, mark, comment = line.rpartition(" # ")
    return f"{keys:{COLUMN - 2}}  # {comment}" if mark else line


def _quoted(text: str) -> str:
    """As a TOML string, which JSON's is too."""
    return json.dumps(text, ensure_ascii=False)


def templates() -> dict[str, str]:
    """The templates that come along, by name, with their titles."""
    paths = sorted((path for path in _folder().iterdir() if path.name.endswith(".toml")), key=lambda path: path.name)
    texts = {path.name.removesuffix(".toml"): path.read_text(encoding="utf-8") for path in paths}
    return {name: tomllib.loads(text)["title"] for name, text in texts.items()}


def _template(template: str, name: str) -> str:
    """A template's text, for a scene of another name."""
    known = list(templates())
    if template not in known:
        raise SceneError(f"--template {template}: is none; {nearest(template, known, 'there are')}")
    text = (_folder() / f"{template}.toml").read_text(encoding="utf-8")
    for before in (f"bstcad generate templates/{template}.toml", f'name = "{template}"', f"outputs/{template}"):
        text = text.replace(before, before.replace("templates/", "").replace(template, name))
    return text


def _folder() -> Traversable:
    """In the package once that is installed, beside it in the source tree."""
    package = resources.files("bstcad")
    return inside if (inside := package / "templates").is_dir() else package / ".." / "templates"


def _written(path: Path, text: str) -> Scene:
    """Put a scene where there is no file, if it loads."""
    from bstcad.scene.scene import load

    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise SceneError(f"{path}: is there already and stays as it is; give another name") from None
    try:
        return load(path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
