"""A photo that is not square becomes a verified lens: the requests of four clicks, without a browser, by few points."""

import io

import numpy as np
import pytest
from PIL import Image

from bstcad import commands
from bstcad.app import design_process
from bstcad.app.design_runs import Run
from bstcad.designs import folder as folders
from bstcad.designs import pipeline
from bstcad.report import record
from bstcad.scene import new_scene
from bstcad.scene.scene import load
from tests import suite
from tests.app.asking import bench
from tests.conftest import draws_nothing, quick_effort, verify_with

SIZES = ((80, 120), (120, 80))  # mm
FEW = {"lens.back.control_points": "33", "target.pixels": "24", "tailoring.rays": "96"}  # made in a second or two


def photo(width, height):
    """A JPEG of these proportions: a bright disc beside the middle, on a grey ground."""
    y, x = np.mgrid[0 : 4 * height, 0 : 4 * width]
    grey = 90 + 120 * np.exp(-((x - 1.6 * width) ** 2 + (y - 2 * height) ** 2) / (0.9 * min(width, height)) ** 2)
    written = io.BytesIO()
    Image.fromarray(grey.astype(np.uint8)).save(written, "jpeg", quality=90)
    return written.getvalue()


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A workbench whose runs are done at once, in this process."""

    def start(run, *options):
        design_process.JOBS["design"]({}, run.folder, run.design, False).put(run.folder)

    monkeypatch.setattr(Run, "_start", start)
    draws_nothing(monkeypatch)
    verify_with(monkeypatch, quick_effort())
    return bench(tmp_path / "lenses", monkeypatch)


def with_scene(own, light, size):
    """Click 1, the file, after the light's card was chosen: the name of the scene."""
    picture = own.ask("/api/picture", photo(*size)).json["picture"]
    return own.ask("/api/scenes", {"light": light, "picture": picture, "size": "120xphoto"}).json["name"]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("light", new_scene.LIGHTS)
def test_plate_and_picture_have_the_proportions_of_the_photo(own, light, size):
    name = with_scene(own, light, size)
    scene = load(own.workspace.path(name))
    assert scene.lens.outline.half_extent == (size[0] / 2, size[1] / 2) and scene.target.remarks() == ()
    assert scene.target.size[0] * size[1] == pytest.approx(scene.target.size[1] * size[0])
    page = own.ask(f"/scene/{name}")
    assert page.status == 200 and '"error": null' in page.text


@pytest.mark.parametrize("crop", ["", "0; 0.5; 1; 1"])
def test_plate_and_picture_take_the_proportions_of_a_photo_that_is_there(own, crop):
    picture = own.ask("/api/picture", photo(80, 120)).json["picture"]
    name = own.ask("/api/scenes", {"light": "led", "picture": picture}).json["name"]
    small = Image.open(io.BytesIO(own.ask(f"/api/scene/{name}/photo.png?key=target").body))
    assert small.size == (320, 480)
    own.ask(f"/api/scene/{name}/change", {"key": "target.crop", "words": crop})
    answer = own.ask(f"/api/scene/{name}/proportions", {"key": "target"}).json
    scene = own.workspace.scene(name, answer["text"])
    sides = (80, 60) if crop else (53.33, 80)
    assert scene.lens.outline.half_extent == pytest.approx([side / 2 for side in sides])
    assert scene.target.size == pytest.approx([6 * side for side in sides], rel=1e-3) and answer["error"] is None
    for key in ("target[3]", "lens", ""):
        assert own.ask("/api/scene/small/proportions", {"key": key}).status == 400  # no photo
    assert own.ask("/api/scene/small/photo.png").status == 400


@pytest.mark.parametrize(("light", "size"), suite.in_turns([("laser", (80, 120)), ("lamp", (120, 80))], 2))
def test_a_photo_is_a_verified_lens_in_four_requests(own, light, size, tmp_path):
    name = with_scene(own, light, size)
    for key, words in FEW.items():
        assert own.ask(f"/api/scene/{name}/change", {"key": key, "words": words}).status == 200
    answer = own.ask(f"/api/scene/{name}/change", {"key": "tailoring.quality", "words": "draft"})  # click 2
    assert answer.json["error"] is None
    made = own.ask(f"/api/scene/{name}/make", {"page": "p"})  # click 3
    assert made.status == 200, made.text
    assert 'id="step"' in own.ask(f"/design/{name}").text
    step = own.ask(f"/design/{name}/files/lens.step?download")  # click 4
    assert step.status == 200 and step.body.startswith(b"ISO-10303-21")
    report = record.read(own.folder / name / "report.json")
    assert [check.name for check in report.checks if not check.passed] == []
    assert commands.verify(own.folder / name / "lens.step").passed
    if light == "laser":  # the lens of a design without the workbench, to the last bit
        alone = pipeline.design(load(own.folder / name / "scene.toml"))
        assert np.array_equal(
            folders.read_nominal(own.folder / name).lens.back.control_points(), alone.lens.back.control_points()
        )
    again = own.ask(f"/api/design/{name}/edit", {}).json["name"]  # and its scene, with the comments that it had
    assert "# the wall with the picture" in own.workspace.opened(again).text
