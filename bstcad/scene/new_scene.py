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
from typing import TYPE_CHECKING, Literal

from bstcad.scene.errors import SceneError, nearest

if TYPE_CHECKING:
    from bstcad.scene.scene import Scene

SIZE = 80.0  # mm, of a plate
THROW = 5.0  # plates: how far the wall is if nobody says; of the sun
THROW_OF_THE_SUN = 2.5  # … whose image on the wall grows with that, and no plate a tenth as thick as wide throws nearer
SLIM = 10.0  # a plate is so many times as wide as thick …
LEAST = 3.0  # … but at least so thick (mm)
RANGES = {"size": (1.0, 10_000.0), "distance": (1.0, 1e7)}  # mm
OVER_BLUR = 1.1  # times the RRMSD of the blurred picture: a draft of few steps comes so near
FEWEST_RRMSD, MOST_RRMSD = 0.05, 0.25  # the tolerance that is written; the latter passes where a scene asks for none

COLUMN = 32  # of a line's comment, where the line is not longer
WIDTH = 118  # of a comment


@dataclass(frozen=True)
class Light:
    """A light to make a plate for; texts are filled with the plate's sizes (`Plate.texts`)."""

    of: str
    header: str  # which light that is
    source: str  # the table [source]
    points: int = 257  # control points a side
    pixels: int = 256
    size: float = 0.0  # mm of a lamp, degrees of parallel light; 0: the picture is as sharp as its pixels
    ahead: float = 0.0  # plates: how far before the plate a lamp is; 0: its light is parallel
    shape: Literal["disc", "square"] = "disc"
    throw: float = THROW
    more: str = ""  # tables
    hint: str = ""  # how detail would be finer


POINT = """\
kind = "point" # with a size: its middle is at the position below
position = [0.0, 0.0, 0.0]
{size}
profile = "lambertian" # radiant intensity falls as cos(angle){as_most}
wavelength = {wavelength}"""

LIGHTS = {
    "laser": Light(
        "a laser's beam",
        "The light is the beam of a laser, widened to the plate and parallel within 0.01 degrees. The sun or a lamp "
        "would smear this picture: bstcad new --light sun, lamp or led makes plates for them.",
        """\
kind = "collimated" # parallel light: the beam of a laser behind a beam expander
real_divergence = 0.01 # degrees, full angle: of the beam as it is; a wider beam is simulated by divergence
wavelength = 532.0 # nm: green; a red one has 650.0; or lines: [[486.1, 1.0], [656.3, 1.0]]
aperture = {{ shape = "rectangle", width = {width}, height = {height} }} # the part of the beam that meets the plate
profile = "gaussian" # brightest in the middle; or "uniform", behind a beam shaper
radius_1e2 = {radius} # mm from the middle, where the irradiance is 1/e² of that""",
        points=513,
        pixels=512,
    ),
    "sun": Light(
        "the sun",
        "The sun stands straight before the plate. It is half a degree wide, and throws an image of itself on the wall "
        "through each place of the plate; bstcad finds the plate whose picture comes out best with that blur.",
        """\
kind = "collimated" # the sun is so far away that each of its points sends parallel rays …
divergence = 0.53 # … and so wide (degrees, full angle) that their directions differ by this much
wavelength = 587.6 # nm: the middle of sunlight; its colours: [[486.1, 1.0], [587.6, 1.0], [656.3, 1.0]]
aperture = {{ shape = "rectangle", width = {width}, height = {height} }} # the light that meets the plate
profile = "uniform" # the same irradiance everywhere in it""",
        size=0.53,
        throw=THROW_OF_THE_SUN,
        hint="a nearer wall makes it finer in proportion",
    ),
    "lamp": Light(
        "a small lamp",
        "The light is that of a small bright lamp, 2 mm across, {before} mm before the plate, without a reflector. "
        "Most of it misses the plate; a lamp nearer to the plate wastes less of it and blurs more.",
        POINT.format(
            size="diameter = 2.0 # mm, of what shines: a filament, a chip",
            as_most="",
            wavelength="587.6 # nm: yellow, in the middle of white light; or lines: [[486.1, 1.0], [656.3, 1.0]]",
        ),
        size=2.0,
        ahead=5.0,
        hint="a smaller lamp, or one further before the plate, makes it finer in proportion",
    ),
    "led": Light(
        "an LED",
        "The light is that of an LED {before} mm before the plate, a chip of 1 mm x 1 mm without a lens of its own. It "
        "goes into a half space; what misses the plate is lost.",
        POINT.format(
            size="width = 1.0 # mm, of the chip; its data sheet has it as the light emitting surface\nheight = 1.0",
            as_most=", as that of most LEDs does",
            wavelength="550.0 # nm; a white LED in one number",
        ),
        size=1.0,
        ahead=1.0,
        shape="square",
        more="""\
[[effects]]
kind = "fresnel" # what both faces reflect is lost: more where the light meets them at a slant

""",
        hint="a smaller chip, or one further before the plate, makes it finer in proportion",
    ),
}
LIGHT = "laser"  # if nobody says

PLATE = """\
# {what} on a wall, by a plate for {of}: change a line, then run
#
#     bstcad generate {name}.toml
#
# Lengths are in mm, angles in degrees, wavelengths in nm.  Light travels along +z, and y is up.
{header}

name = "{name}" # the design goes to outputs/{name}
title = {title} # one line, for the report

[source]
{source}

[lens]
material = "PMMA" # acrylic; or "PC", "N-BK7" …, any page of refractiveindex.info, or index = 1.49
outline = {{ shape = "rectangle", width = {width}, height = {height} }} # or {{ shape = "circle", diameter = {least} }}
front = {{ kind = "plane", z = {before} }} # the flat face, where the light enters
back = {{ kind = "bspline", z = {back}, control_points = {points} }} # the face bstcad finds, flat before
min_thickness = {thinnest} # mm, everywhere

[target]
z = {wall} # the wall, {distance} mm behind the plate
x = [-{half_x}, {half_x}] # {as_wide}
y = [-{half_y}, {half_y}]
pixels = {pixels} # along {side}
{picture}
seen_from = "lens" # upright and unmirrored for a person at the plate who looks at the wall;
# seen_from = "behind" # … for a person behind a translucent screen who looks at the plate

[tailoring]
quality = "standard" # draft | standard | fine: more time, less error
# max_time = 60.0 # s, from the command to the report: the best that fits

{more}[accept]  # what the report holds the lens to
{rrmsd}
"""
IMAGE = """\
image = {path} # relative to this file; or text = "…", a sample, uniform = true
fit = "crop" # of a picture of other proportions; or "pad", "stretch"
# gamma = 1.0 # for a file that holds light itself; else a photo is read as a screen shows it"""
TEXT = """\
text = "Hello" # or image = "photo.jpg" (relative to this file), a sample, uniform = true"""


@dataclass(frozen=True)
class Plate:
    """A plate, the wall behind it and the light before it (mm); SceneError from `of`."""

    light: Light
    width: float
    height: float
    distance: float

    @classmethod
    def of(
        cls, light: str | None = None, size: str | float | None = None, distance: str | float | None = None
    ) -> Plate:
        """Of what a user says; None: the usual."""
        if light is not None and light not in LIGHTS:
            raise SceneError(f"--light {light}: is none; {nearest(light, list(LIGHTS), 'give one of')}")
        found = LIGHTS[light or LIGHT]
        width, height = _sides(size)
        try:
            far = found.throw * max(width, height) if distance is None else float(distance)
        except ValueError:
            raise SceneError(f"--distance {distance}: is no distance; give mm, such as 2000") from None
        return cls(found, width, height, _in_range("distance", far))

    @property
    def thickness(self) -> float:
        """To half a millimetre."""
        return max(LEAST, math.ceil(2 * max(self.width, self.height) / SLIM) / 2)

    @property
    def before(self) -> float:
        """From the lamp to the plate; 0 of parallel light."""
        return self.light.ahead * max(self.width, self.height)

    @property
    def magnified(self) -> float:
        """Times the plate: as wide is the picture, and as its shadow."""
        return 1 + self.distance / self.before if self.before else 1.0

    @property
    def pixel(self) -> float:
        """The side of a pixel."""
        return self.magnified * max(self.width, self.height) / self.light.pixels

    def source_image(self, distance: float) -> float:
        """The side of the source's image on a wall so far away: 2 L tan(δ / 2), or d L / l from l before the plate."""
        if self.before:
            return self.light.size * distance / self.before
        return 2 * distance * math.tan(math.radians(self.light.size / 2))

    def expectation(self, blurred: float | None = None) -> str:
        """Which detail survives, in a sentence; blurred: RRMSD of the picture by the source's image alone."""
        wide, detail = self.magnified * max(self.width, self.height), self.detail(self.distance)
        said = (
            f"The finest detail on this wall is {detail:.2g} mm wide, 1/{wide / detail:.0f} of the picture's "
            f"{wide:.4g} mm"
        )
        if blurred is None:
            return f"{said}."
        nearer = self.light.throw * max(self.width, self.height)
        if not self.before and nearer < self.distance:
            said += f"; on a wall at {nearer:g} mm it is {self.detail(nearer):.2g} mm (--distance {nearer:g})"
        elif self.light.hint:
            said += f"; {self.light.hint}"
        if blurred > MOST_RRMSD:
            said += f". That is too coarse for this picture, which it changes by an RRMSD of {blurred:.2g}"
        return f"{said}."

    def detail(self, distance: float) -> float:
        """The width of the finest detail on a wall so far away (optics.source_images.detail_width)."""
        from bstcad.optics.source_images import detail_width  # loads torch, which a list of the templates need not

        as_a_disc = math.sqrt(4 / 3) if self.light.shape == "square" else 1.0
        return detail_width(as_a_disc * self.source_image(distance), self.pixel)

    def blurred(self, scene: Scene) -> float | None:
        """RRMSD of the scene's picture blurred by the source's image alone; None: the source has no size."""
        from bstcad.optics.outlines import Circle, Rectangle
        from bstcad.optics.source_images import even_image

        if not self.light.size:
            return None
        wide = self.source_image(self.distance) / self.pixel
        image = Circle(wide / 2) if self.light.shape == "disc" else Rectangle(wide, wide)
        return even_image(image).deviation(scene.target.irradiance())

    def text(self, name: str, picture: Path | None = None, blurred: float | None = None) -> str:
        """The scene file, with the picture of that path or else with letters."""
        back, wide, light = self.before + self.thickness, self.magnified, self.light
        image = None if picture is None else IMAGE.format(path=_quoted(picture.as_posix()))
        numbers = {
            "width": self.width,
            "height": self.height,
            "least": min(self.width, self.height),
            "radius": max(self.width, self.height) / 2,
            "before": self.before,
            "back": back,
            "wall": back + self.distance,
            "half_x": wide * self.width / 2,
            "half_y": wide * self.height / 2,
            "thinnest": self.thickness / 4,
        }
        texts = {key: _number(value) for key, value in numbers.items()}
        header = f"{light.header} {self.expectation(blurred)}".format(before=f"{self.before:g}")
        text = PLATE.format(
            name=name,
            what="Letters" if image is None else "A picture",
            of=light.of,
            title=_quoted(f"{name}, for {light.of}"),
            header="\n".join(f"# {line}" for line in textwrap.wrap(header, WIDTH)),
            source=light.source.format(**texts),
            points=light.points,
            pixels=light.pixels,
            side="each side" if self.width == self.height else "the longer side",
            distance=f"{self.distance:g}",
            as_wide="as wide as the plate, on its axis" if wide == 1 else "as wide as the plate's shadow, on its axis",
            picture=image or TEXT,
            more=light.more,
            rrmsd=_tolerance(blurred),
            **texts,
        )
        return "\n".join(map(_aligned, text.split("\n")))


def _tolerance(blurred: float | None) -> str:
    """The line of the RRMSD: as much as the source's size by itself changes the picture, and OVER_BLUR."""
    if blurred is None:
        return "# rrmsd = 0.1 # relative RMS deviation of the irradiance from the picture"
    rrmsd = min(max(math.ceil(100 * OVER_BLUR * blurred) / 100, FEWEST_RRMSD), MOST_RRMSD)
    of = f"relative RMS deviation from the picture; blurred by the source, it is off by {blurred:.2g}"
    return f"rrmsd = {rrmsd:g} # {of}"


@dataclass(frozen=True)
class Written:
    """A new scene file."""

    path: Path
    said: str = ""  # of the light, and of the detail that it leaves; nothing of a template


def new_scene(
    name: str,
    folder: Path,
    *,
    picture: Path | None = None,
    light: str | None = None,
    size: str | float | None = None,
    distance: str | float | None = None,
    template: str | None = None,
) -> Written:
    """Write NAME.toml to `folder`, a commented scene that loads; never over another file.  SceneError.

    A plate of that size (mm; one number, or "80x60", width by height), a picture as large as what the plate covers on a
    wall at that distance, by that light (LIGHTS); or a copy of a template.  The path of the picture is relative to the
    folder.
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
        if (picture, light, size, distance) != (None,) * 4:
            raise SceneError(
                f"--template {template}: has a light, a picture and sizes of its own; give either it or them"
            )
        _written(path, renamed(_template(template).read_text(encoding="utf-8"), name))
        return Written(path)
    plate = Plate.of(light, size, distance)
    if picture is not None:
        picture = Path(os.path.expanduser(picture))
        if not (folder / picture).exists():
            raise SceneError(f"--picture {picture}: not found; give the path of a picture file")
        read_picture(folder / picture)  # before anything is written
    scene = _written(path, plate.text(name, picture))
    if (blurred := plate.blurred(scene)) is not None:
        path.write_text(plate.text(name, picture, blurred), encoding="utf-8")
    *others, last = (name for name in LIGHTS if LIGHTS[name] != plate.light)
    made = f"A plate for {plate.light.of}; --light {', '.join(others)} or {last} makes it for another light."
    words = 'The picture is the word "Hello"; target.text in the file has it, --picture FILE another.'
    of_picture = [words] if picture is None else scene.target.remarks()
    return Written(path, "\n".join([made, plate.expectation(blurred), *of_picture]))


def _sides(size: str | float | None) -> tuple[float, float]:
    """Width and height (mm) of what a user says: 80, or "80x60"."""
    if size is None:
        return SIZE, SIZE
    try:
        sides = [float(side) for side in re.split("[xX×]", str(size))]
    except ValueError:
        sides = []
    if len(sides) not in (1, 2):
        raise SceneError(f"--size {size}: is no size; give mm, such as 80, or width x height, such as 80x60")
    width, height = (_in_range("size", side) for side in (sides[0], sides[-1]))
    return width, height


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
