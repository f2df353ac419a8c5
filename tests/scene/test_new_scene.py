"""`bstcad new`: a commented scene that loads and becomes a lens, the templates, which an installed bstcad has too."""

import re
import tomllib
import zipfile
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
SMALL = {"control_points": 33, "pixels": 48}


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


class TestPlate:
    def test_a_picture_of_a_size_at_a_distance(self, place):
        path = new_scene.new_scene("photo-lens", place, picture=PHOTO, size=60, distance=400)
        assert path == place / "photo-lens.toml" and [p.name for p in place.iterdir()] == ["photo-lens.toml"]
        scene = load(path)
        assert scene.name == "photo-lens" and scene.lens.material == "PMMA"
        assert scene.lens.outline.half_extent == scene.source.aperture.half_extent == (30, 30)
        assert (scene.target.x, scene.target.y) == ((-30, 30), (-30, 30))
        assert scene.target.z - scene.lens.back.z == 400 and scene.lens.back.z - scene.lens.front.z == 6
        assert scene.target.image.data == PHOTO.read_bytes() and scene.warnings() == ()

    def test_letters_if_there_is_no_picture(self, place):
        scene = load(new_scene.new_scene("hello", place))
        assert scene.target.text == "Hello" and scene.lens.outline.half_extent == (40, 40)
        assert scene.target.z - scene.lens.back.z == 400

    @pytest.mark.parametrize(("size", "thickness"), [(1, 3), (20, 3), (33, 3.5), (80, 8), (300, 30)])
    def test_a_plate_is_as_thick_as_it_is_wide_at_a_glance(self, place, size, thickness):
        scene = load(new_scene.new_scene("plate", place, size=size))
        assert scene.lens.back.z == thickness and scene.tolerances.min_thickness == thickness / 4

    @pytest.mark.parametrize("picture", [None, PHOTO])
    def test_each_line_is_explained(self, place, picture):
        lines = new_scene.plate("lens", picture).splitlines()
        assert max(map(len, lines)) <= 120
        keys = [line for line in lines if re.match(r"(# )?\w+ = ", line)]
        assert len(keys) >= 17 and [line[:3] for line in keys if " # " not in line[2:]] == ["y ="]
        assert any(line.startswith('seen_from = "lens"') for line in keys)

    def test_it_becomes_a_lens(self, place, capsys):
        """The command, then the one that it names, on a small net."""
        assert cli.run(["new", "photo-lens", "--picture", str(PHOTO), "--size", "40", "--distance", "300"]) == 0
        said = capsys.readouterr().out
        assert said == "photo-lens.toml is written; next: bstcad generate photo-lens.toml\n"
        scene = place / "photo-lens.toml"
        text = scene.read_text(encoding="utf-8")
        for key, value in SMALL.items():
            text = re.sub(rf"{key} = \d+", f"{key} = {value}", text)
        scene.write_text(text, encoding="utf-8")
        assert cli.run([*said.split("bstcad ")[1].split(), "--quality", "draft"]) == 0
        assert (place / "outputs" / "photo-lens" / "lens.step").exists()


class TestTemplates:
    def test_all_of_them_are_listed(self, capsys):
        assert cli.run(["new", "--list"]) == 0
        listed = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
        assert list(listed) == TEMPLATES and listed["portrait"].startswith("A portrait from a point source")

    @pytest.mark.parametrize("template", TEMPLATES)
    def test_a_copy_is_the_same_scene_of_another_name(self, place, template):
        path = new_scene.new_scene("mine", place, template=template)
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
        with pytest.raises(SceneError, match=r"mine\.toml: is there already and stays as it is; give another name"):
            new_scene.new_scene("mine", place, **more)
    assert (place / "mine.toml").read_text() == "precious" and len(list(place.iterdir())) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "missing argument 'NAME'; give a name for the scene, or --list"),
        (["../mine"], "'../mine' is no name for a scene; give one of letters"),
        ([""], "'' is no name for a scene"),
        (["mine", "--picture", "none.jpg"], "target.image: 'none.jpg' not found"),
        (["mine", "--picture", __file__], "is no "),
        (["mine", "--size", "0"], "--size 0: is not between 1 and 10000 mm; choose one in between"),
        (["mine", "--size", "nan"], "--size nan: is not between"),
        (["mine", "--distance", "-3"], "--distance -3: is not between"),
        (["mine", "--template", "thou"], "--template thou: is none; did you mean 'thu'?"),
        (["mine", "--template", "thu", "--size", "9"], "--template thu: has a picture and sizes of its own"),
    ],
)
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
    code = {path.relative_to(ROOT).as_posix() for path in (ROOT / "bstcad").rglob("*.py")}
    assert code < names and not any(name.startswith("tests") for name in names)
    with zipfile.ZipFile(built) as archive:
        [entry] = (name for name in names if name.endswith("entry_points.txt"))
        assert "bstcad = bstcad.cli:main" in archive.read(entry).decode()
        assert tomllib.loads(archive.read("bstcad/templates/thu.toml").decode())["name"] == "thu"
