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

TEMPLATE = Path(__file__).with_name("plate.toml.j2")
COLUMN = 32  # of a line's comment, where the line is not longer
WIDTH = 118  # of a comment


@dataclass(frozen=True)
class Light:
    """A light to make a plate for; its table [source] stands in plate.toml.j2."""

    name: str  # of the option --light
    of: str
    header: str  # which light that is; {before}: mm before the plate
    points: int = 257  # control points a side
    pixels: int = 256
    size: float = 0.0  # mm of a lamp, degrees of parallel light; 0: the picture is as sharp as its pixels
    ahead: float = 0.0  # plates: how far before the plate a lamp is; 0: its light is parallel
    shape: Literal["disc", "square"] = "disc"
    throw: float = THROW
    hint: str = ""  # how detail would be finer


LASER = Light(
    name="laser",
    of="a laser's beam",
    header="The light is the beam of a laser, widened to the plate and parallel within 0.01 degrees. The sun or a lamp "
    "would smear this picture: bstcad new --light sun, lamp or led makes plates for them.",
    points=513,
    pixels=512,
)
SUN = Light(
    name="sun",
    of="the sun",
    header="The sun stands straight before the plate. It is half a degree wide, and throws an image of itself on the "
    "wall through each place of the plate; bstcad finds the plate whose picture comes out best with that blur.",
    size=0.53,
    throw=THROW_OF_THE_SUN,
    hint="a nearer wall makes it finer in proportion",
)
LAMP = Light(
    name="lamp",
    of="a small lamp",
    header="The light is that of a small bright lamp, 2 mm across, {before} mm before the plate, without a reflector. "
    "Most of it misses the plate; a lamp nearer to the plate wastes less of it and blurs more.",
    size=2.0,
    ahead=5.0,
    hint="a smaller lamp, or one further before the plate, makes it finer in proportion",
)
LED = Light(
    name="led",
    of="an LED",
    header="The light is that of an LED {before} mm before the plate, a chip of 1 mm x 1 mm without a lens of its own. "
    "It goes into a half space; what misses the plate is lost.",
    size=1.0,
    ahead=1.0,
    shape="square",
    hint="a smaller chip, or one further before the plate, makes it finer in proportion",
)
LIGHTS = {light.name: light for light in (LASER, SUN, LAMP, LED)}  # the first if nobody says


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
        found = LIGHTS[light or LASER.name]
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
        """The width of the finest detail on a wall so far away (optics.measure.detail_width)."""
        from bstcad.optics.measure import detail_width  # loads torch, which a list of the templates need not

        as_a_disc = math.sqrt(4 / 3) if self.light.shape == "square" else 1.0
        return detail_width(as_a_disc * self.source_image(distance), self.pixel)

    def blurred(self, scene: Scene) -> float | None:
        """RRMSD of the scene's picture blurred by the source's image alone; None: the source has no size."""
        from bstcad.optics.measure import even_image
        from bstcad.optics.outlines import Circle, Rectangle

        if not self.light.size:
            return None
        wide = self.source_image(self.distance) / self.pixel
        image = Circle(wide / 2) if self.light.shape == "disc" else Rectangle(wide, wide)
        return even_image(image).deviation(scene.target.irradiance())

    def text(self, name: str, picture: Path | None = None, blurred: float | None = None) -> str:
        """The scene file, with the picture of that path or else with letters."""
        import jinja2  # which a list of the templates need not wait for

        before, wide, light = self.before, self.magnified, self.light
        back = before + self.thickness
        subject = "Letters" if picture is None else "A picture"
        header = f"{light.header} {self.expectation(blurred)}".format(before=f"{before:g}")
        first = f"{subject} on a wall, by a plate for {light.of}: change a line, then run"
        units = "Lengths are in mm, angles in degrees, wavelengths in nm.  Light travels along +z, and y is up."
        head = [first, "", f"    bstcad generate {name}.toml", "", units, *textwrap.wrap(header, WIDTH)]
        text = jinja2.Template(
            TEMPLATE.read_text(encoding="utf-8"), trim_blocks=True, keep_trailing_newline=True
        ).render(
            name=name,
            title=_quoted(f"{name}, for {light.of}"),
            header="\n".join(f"# {line}".rstrip() for line in head),
            light=light.name,
            points=light.points,
            pixels=light.pixels,
            width=self.width,
            height=self.height,
            least=min(self.width, self.height),
            radius=max(self.width, self.height) / 2,
            before=float(before),
            back=back,
            thinnest=self.thickness / 4,
            wall=back + self.distance,
            distance=f"{self.distance:g}",
            half_x=wide * self.width / 2,
            half_y=wide * self.height / 2,
            shadow=wide != 1,
            picture=picture and _quoted(picture.as_posix()),
            rrmsd=blurred and f"{_limit(blurred):g}",
            blurred=None if blurred is None else f"{blurred:.2g}",
        )
        return "\n".join(map(_aligned, text.split("\n")))


def _limit(blurred: float) -> float:
    """The RRMSD that the scene accepts: OVER_BLUR times that of the picture blurred by the source's size alone."""
    return min(max(math.ceil(100 * OVER_BLUR * blurred) / 100, FEWEST_RRMSD), MOST_RRMSD)


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


def _quoted(text: str) -> str:
    """As a TOML string, which JSON's is too."""
    return json.dumps(text, ensure_ascii=False)
