"""`bstcad new`: a commented scene that loads and becomes a lens, the templates, which an installed bstcad has too."""

import math
import re
import tomllib
import zipfile
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from hatchling.builders.wheel import WheelBuilder
from PIL import Image

from bstcad import cli
from bstcad.scene import new_scene
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load

ROOT = Path(__file__).parent.parent.parent
TEMPLATES = sorted(path.stem for path in (ROOT / "templates").glob("*.toml"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty working folder with a photo in a folder beside it."""
    (tmp_path / "photos").mkdir()
    grey = np.linspace(40, 255, 40)[:, None] * np.ones((1, 40))
    Image.fromarray(grey.astype(np.uint8)).save(tmp_path / "photos" / 'my "best" photo.png')
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


PHOTO = Path("..", "photos", 'my "best" photo.png')


def written(place, *arguments):
    """The scene that the command writes, and its text."""
    assert cli.run(["new", "mine", *arguments]) == 0
    return load(place / "mine.toml"), (place / "mine.toml").read_text(encoding="utf-8")


class TestPlate:
    def test_a_picture_of_a_size_at_a_distance(self, place):
        path = new_scene.new_scene("photo-lens", place, picture=PHOTO, size=60, distance=400).path
        assert path == place / "photo-lens.toml" and [p.name for p in place.iterdir()] == ["photo-lens.toml"]
        scene = load(path)
        assert scene.name == "photo-lens" and scene.lens.material == "PMMA"
        assert scene.lens.outline.half_extent == scene.source.aperture.half_extent == (30, 30)
        assert (scene.target.x, scene.target.y) == ((-30, 30), (-30, 30))
        assert scene.target.z - scene.lens.back.z == 400 and scene.lens.back.z - scene.lens.front.z == 6
        assert scene.target.image.data == PHOTO.read_bytes() and scene.warnings() == ()

    @pytest.mark.parametrize("light", new_scene.LIGHTS)
    def test_each_line_is_explained(self, light):
        lines = new_scene.Plate.of(light).text("lens", PHOTO, 0.123).splitlines()
        assert max(map(len, lines)) <= 120
        keys = [line for line in lines if re.match(r"(# )?\w+ = ", line)]
        bare = [line.partition(" ")[0] for line in keys if " # " not in line[2:]]
        assert len(keys) >= 17 and bare in (["y"], ["position", "y"], ["position", "height", "y"])
        assert any(line.startswith('seen_from = "lens"') for line in keys)

    @pytest.mark.parametrize(("light", "wide"), [("sun", 1.0), ("led", 6.0)])
    def test_a_plate_of_other_proportions_has_a_picture_of_the_same(self, place, capsys, light, wide):
        sizes = ["--light", light, "--size", "80x60", "--distance", "400"]
        scene, _ = written(place, *sizes)
        assert 'The picture is the word "Hello"' in capsys.readouterr().out
        assert scene.lens.outline.half_extent == (40, 30)
        assert scene.target.size == (80 * wide, 60 * wide) and scene.target.screen.shape == (192, 256)
        assert cli.run(["new", "photo", "--picture", str(PHOTO), *sizes]) == 0
        size = f"{80 * wide:g} x {60 * wide:g} mm"
        assert f"the target is {size}, so the picture of 40 x 40 is cropped to the central" in capsys.readouterr().out

    @pytest.mark.parametrize(("size", "given", "made"), [
        ((800, 1200), "photo", (53.33, 80.0)), ((1200, 800), "120xphoto", (120.0, 80.0)),
    ])  # fmt: skip
    def test_a_plate_in_the_proportions_of_the_photo(self, place, size, given, made):
        Image.new("L", size, 200).save(place / "p.png")
        scene, _ = written(place, "--picture", "p.png", "--size", given)
        assert scene.lens.outline.half_extent == pytest.approx((made[0] / 2, made[1] / 2))
        assert scene.target.size == pytest.approx(made) and scene.target.remarks() == ()
        assert scene.source.aperture == scene.lens.outline


class TestLight:
    """The light that is asked for is simulated, and the file and the command say which detail it leaves."""

    def test_the_sun_is_half_a_degree_wide(self, place, capsys):
        """2 · 600 mm · tan(0.265°) = 5.55 mm, at 250 mm 2.31 mm; with pixels of 0.39 mm √(… + 4/3 · 0.39²)."""
        scene, text = written(place, "--picture", str(PHOTO), "--light", "sun", "--size", "100", "--distance", "600")
        assert scene.source.kind == "collimated" and scene.source.divergence == 0.53
        assert scene.source.profile == "uniform" and scene.source.aperture == scene.lens.outline
        printed = capsys.readouterr().out
        assert "The finest detail on this wall is 5.6 mm wide, 1/18 of the picture's 100 mm; on a wall at" in printed
        assert "at 250 mm it is 2.4 mm (--distance 250)." in printed
        assert text.startswith("# A picture on a wall, by a plate for the sun") and "target.fit" not in printed
        assert printed.endswith("\nmine.toml is written; next: bstcad generate mine.toml\n")

    def test_the_tolerance_of_the_sun_is_that_of_its_blur(self, place):
        """A disc of radius R, its edge blurred by one of diameter D, 18 pixels: ∫ err² = 0.0676 D · 2 π R, of π R²."""
        scene, text = written(place, "--light", "sun", "--distance", "150")
        plate = new_scene.Plate.of("sun", 80, 600)
        disc = {"target.text": None, "target.uniform": True, "target.outline": {"shape": "circle", "radius": 30.0}}
        assert plate.blur_rrmsd(scene.changed(disc)) == pytest.approx(math.sqrt(0.0676 * 5.55 * 2 / 30), rel=0.08)
        blurred = new_scene.Plate.of("sun", 80, 150).blur_rrmsd(scene)
        assert scene.accept.rrmsd == math.ceil(110 * blurred) / 100 < new_scene.MAX_RRMSD
        assert "of the picture blurred by the source" in text

    @pytest.mark.parametrize("light", new_scene.LIGHTS)
    def test_no_comment_states_a_figure_that_a_change_makes_wrong(self, light):
        """Two plates of other sizes and distances have the same comments."""
        texts = (new_scene.Plate.of(light, size, far).text("x", None, 0.1) for size, far in ((40, 300), ("90x70", 900)))
        comments = [re.findall(r"# .*", re.sub(r"diameter = [\d.]+", "", text)) for text in texts]
        assert [line.replace("along each side", "along the longer side") for line in comments[0]] == comments[1]

    @pytest.mark.parametrize(("arguments", "made", "sentence"), [
        ([], {"source.kind": "collimated", "source.extent": None, "source.profile": "gaussian", "source.radius_1e2": 40,
              "source.real_divergence": 0.01}, "for a laser's beam; --light sun, lamp or led"),
        (["--light", "sun", "--distance", "5000"], {"accept.rrmsd": new_scene.MAX_RRMSD},
         "is 46 mm wide, 1/2 of the picture's 80 mm; on a wall at 200 mm it is 1.9 mm (--distance 200). The blur "
         "is too large for this picture, which it changes by an RRMSD of 0."),
        # 2 mm at 400 mm before the plate: on a wall 200 mm behind it 1 mm, and the shadow is 1.5 times the plate
        (["--light", "lamp", "--distance", "200"], {"source.kind": "point", "source.diameter": 2, "lens.front.z": 400,
                                                    "target.size": (120, 120)}, "is 1.1 mm wide, 1/106 of the"),
        # 1 mm at 80 mm: on a wall at 400 mm 5 mm, as wide as a disc of 5.8 mm; its faces reflect at a slant
        (["--light", "led"], {"source.width": 1, "source.profile": "lambertian", "lens.front.z": 80},
         "is 6.2 mm wide behind the centre of the plate, and less beside it, where the chip is seen at an angle, 1/78 "
         "of the picture's 480 mm; a smaller chip"),
    ])  # fmt: skip
    def test_the_light_is_simulated_and_its_detail_is_said(self, place, capsys, arguments, made, sentence):
        scene, _ = written(place, *arguments)
        assert {key: attrgetter(key)(scene) for key in made} == made
        assert sentence in capsys.readouterr().out
        assert [effect.kind for effect in scene.effects] == ["fresnel"] * ("led" in arguments)


class TestTemplates:
    def test_all_of_them_are_listed(self, capsys):
        assert cli.run(["new", "--list"]) == 0
        listed = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
        assert list(listed) == TEMPLATES and listed["portrait"].startswith("A portrait from a point source")

    @pytest.mark.parametrize("template", TEMPLATES)
    def test_a_copy_is_the_same_scene_of_another_name(self, place, template):
        path = new_scene.new_scene("mine", place, template=template).path
        assert load(path) == load(ROOT / "templates" / f"{template}.toml", {"name": "mine"})
        text = path.read_text(encoding="utf-8")
        assert "bstcad generate mine.toml" in text and "outputs/mine" in text
        assert f"{template}.toml" not in text.replace("mine.toml", "") and f"outputs/{template}" not in text

    def test_an_installed_one_finds_them_inside(self, tmp_path, monkeypatch):
        (tmp_path / "templates").mkdir()
        (tmp_path / "templates" / "only.toml").write_text('name = "only"\ntitle = "The only one"\n')
        monkeypatch.setattr(new_scene.resources, "files", lambda package: tmp_path)
        assert new_scene.templates() == {"only": "The only one"}


def test_nothing_is_written_over(place):
    (place / "mine.toml").write_text("precious")
    for more in ({}, {"template": "thu"}, {"picture": PHOTO}):
        with pytest.raises(SceneError, match=r"mine\.toml: .* give another name"):
            new_scene.new_scene("mine", place, **more)
    assert (place / "mine.toml").read_text() == "precious" and len(list(place.iterdir())) == 1


@pytest.mark.parametrize(("arguments", "sentence"), [
    ([], "missing argument 'NAME'; give a name for the scene, or --list"),
    (["mine", "--size", "photo"], "--size photo: needs a photo; give --picture FILE"),
    (["../mine"], "'../mine' cannot be the name of a scene"),
    (["mine", "--picture", "none.jpg"], "--picture none.jpg: not found; give the path of a picture file"),
    (["mine", "--picture", __file__], "is not a "),
    (["mine", "--size", "80by60"], "--size 80by60: is not a size; give a length in mm, such as 80, or width x height"),
    (["mine", "--light", "moon"], "--light moon: no such light; give one of laser, sun, lamp, led"),
    (["mine", "--distance", "-3"], "--distance -3: is not between"),
    (["mine", "--template", "thou"], "--template thou: no such template; did you mean 'thu'?"),
    (["mine", "--template", "thu", "--size", "9"], "--template thu: a template has its own light, picture and sizes"),
])  # fmt: skip
def test_what_is_wrong_is_one_sentence_and_writes_nothing(place, capsys, arguments, sentence):
    assert cli.run(["new", *arguments]) == 2
    out, err = capsys.readouterr()
    assert err.startswith("bstcad: ") and sentence in err and err.count("\n") == 1 and out == ""
    assert list(place.iterdir()) == []


def test_the_wheel_holds_the_templates_and_what_is_beside_the_code(tmp_path):
    [built] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = set(zipfile.ZipFile(built).namelist())
    assert {f"bstcad/templates/{name}.toml" for name in TEMPLATES} < names
    assert "bstcad/templates/flanged_lens.py" in names and "bstcad/report/report.html.j2" in names
    assert {f"bstcad/scene/{name}" for name in ("lights.toml", "plate.toml.j2")} < names
    code = {path.relative_to(ROOT).as_posix() for path in (ROOT / "bstcad").rglob("*.py")}
    assert code < names and not any(name.startswith("tests") for name in names)
    with zipfile.ZipFile(built) as archive:
        [entry] = (name for name in names if name.endswith("entry_points.txt"))
        assert "bstcad = bstcad.cli:main" in archive.read(entry).decode()
        assert tomllib.loads(archive.read("bstcad/templates/thu.toml").decode())["name"] == "thu"
