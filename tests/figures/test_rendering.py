"""The 3-D picture: drawn where the machine can, None where it cannot, and never a crash or a line on the terminal.

The lens that a page turns is the lens: read back as the script reads it, its nodes and slopes are the same; and so is
the light that a page shows with it.
"""

import base64
import io
import json
import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from bstcad import Circle, Lens, Plane, Rectangle, Sphere, commands
from bstcad.cad.mesh import Mesh
from bstcad.figures import rendering
from bstcad.figures.figure_jobs import Pictures
from bstcad.optics.lens import face_integrals
from bstcad.optics.surfaces.bspline import BSplineSurface
from bstcad.optics.surfaces.surfaces import Recess
from bstcad.verify.nominal import Nominal

CUBE = trimesh.creation.box((24.0, 24.0, 10.0))
OUTLINES = (Rectangle(8.0, 6.0), Circle(4.0))
BOX = Mesh(np.asarray(CUBE.vertices), np.asarray(CUBE.faces))


def test_picture_is_a_png_on_a_transparent_ground_and_quiet(capfd):
    picture = rendering.lens_picture(BOX)
    assert capfd.readouterr() == ("", "")
    if picture is None:
        pytest.skip("this machine cannot draw in 3-D")
    pixels = np.asarray(Image.open(io.BytesIO(picture)))
    assert pixels.shape[2] == 4
    assert pixels[0, 0, 3] == 0  # the corner is ground
    assert 0.4 < (pixels[..., 3] > 0).mean() < 1.0
    assert len(picture) < 300_000


def test_a_renderer_that_dies_or_hangs_gives_no_picture(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(rendering.sys, "executable", shutil.which("false"))
        assert rendering.lens_picture(BOX) is None
    monkeypatch.setattr(rendering, "PATIENCE", 0.01)
    assert rendering.lens_picture(BOX) is None


def test_an_interrupted_report_waits_for_no_picture(small_scene, monkeypatch, tmp_path):
    """A Ctrl-C ends the process that draws, which would take seconds, or a minute on a busy machine."""
    slow = tmp_path / "slow"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o755)
    monkeypatch.setattr(rendering.sys, "executable", str(slow))
    found = []
    with (
        pytest.raises(KeyboardInterrupt),
        Pictures(Nominal(small_scene, None, small_scene.goals), submit=None) as drawn,
    ):
        job = drawn._vtk.submit(lambda: found.append(rendering.lens_picture(BOX)))
        while not rendering._drawing and not job.done():
            time.sleep(0.01)
        [drawing] = rendering._drawing
        raise KeyboardInterrupt
    assert found == [None] and drawing.returncode == -signal.SIGKILL  # not 0, the end of its sleep


def lens(front, outline):
    """A gently waved back over a front."""
    u = np.linspace(-5.0, 5.0, 33)
    x, y = np.meshgrid(u, u, indexing="ij")
    net = np.stack([x, y, 25.0 + 0.02 * np.sin(x) * np.cos(2 * y) + 0.3 * x], axis=-1)
    return Lens.between(front, BSplineSurface.from_control_points(net, 25.0), outline, 1.49)


def read(text):
    """(faces, rim) as solid_view.js has them: (5, side, side) of x, y, z and slopes; (4, k) of x, y, low z, high z."""
    told = json.loads(text)
    values = np.frombuffer(base64.b64decode(told["values"]), "<u2") / 65535
    low, size = np.array(told["low"]), np.array(told["size"])
    faces, at = [], 0
    for face in told["faces"]:
        side = face["cells"] + 1
        part = values[at : at + 5 * side**2].reshape(5, side, side)
        at += part.size
        faces.append(np.stack([*(low + size * part[:3].T).T, *(face["steepest"] * (2 * part[3:] - 1))]))
    rim = values[at:].reshape(4, told["rim"])
    return faces, np.stack([low[k] + size[k] * rim[n] for n, k in enumerate((0, 1, 2, 2))])


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda outline: outline.shape)
@pytest.mark.parametrize("front", [Plane(15.0), Sphere(15.0, 0.03)], ids=lambda front: front.kind)
def test_nodes_and_slopes_are_those_of_the_surfaces(front, outline):
    made = lens(front, outline)
    faces, rim = read(rendering.turnable(made))
    for surface, (x, y, z, *slopes) in zip((made.back, made.front), faces, strict=True):
        found = surface.plain().sag_and_slope(*(torch.from_numpy(p.ravel().copy()) for p in (x, y)))
        for wanted, stated in zip(found, (z, *slopes), strict=True):
            np.testing.assert_allclose(stated.ravel(), wanted, atol=4e-4)  # 1/65535 of 10 mm, times the steepest slope
    border = np.hypot(rim[0], rim[1]) if outline.shape == "circle" else np.maximum(abs(rim[0]) - 1, abs(rim[1]))
    np.testing.assert_allclose(border, outline.half_extent[1], atol=2e-4)
    assert (rim[3] > rim[2] + 5).all()
    steps = np.hypot(*(np.roll(rim[:2], -1, axis=1) - rim[:2]))
    assert steps.max() < 3 * steps.mean()  # once around, without a jump


@pytest.mark.parametrize("outline", OUTLINES, ids=lambda outline: outline.shape)
def test_a_dome_in_the_underside_is_drawn_with_the_plane_around_it(outline):
    """The volume below the faces, as solid_view.js divides them, is the lens's; between them there is no gap."""
    made = lens(Recess(Sphere(15.0, -0.3), Circle(2.5)), outline)
    faces, _ = read(rendering.turnable(made))
    assert len(faces) == 6
    volume = area = 0.0
    for face, up in zip(faces, (1, -1, -1, -1, -1, -1), strict=True):
        a, b, c, d = (face[:3, i : i - 1 or None, j : j - 1 or None] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
        flat = ((c - a)[0] * (d - b)[1] - (c - a)[1] * (d - b)[0]) / 2  # of a cell, seen along z; counterclockwise
        assert flat.min() > 0
        volume += up * float((flat * (a + b + c + d)[2] / 4).sum())
        area += up * float(flat.sum())
    assert volume == pytest.approx(face_integrals.of_lens(made).volume, rel=2e-3) and abs(area) < 2e-3 * outline.area


def test_what_is_not_finite_is_not_drawn():
    made = lens(Plane(15.0), OUTLINES[0])
    made.back.heights[5, 5] = float("nan")
    assert rendering.turnable(made) == ""


def test_it_is_small_and_no_text_of_a_page(small_design):
    page = (small_design.folder / "report.html").read_text(encoding="utf-8")
    assert len(page) < 3_000_000  # of 6 MB that a report may have, before the pictures of judges and made parts
    text = page[page.index('id="solid">') + 11 :].partition("</script>")[0]
    assert "<" not in text and json.loads(text)["rim"] == 4 * rendering.FINE


@pytest.fixture(scope="module")
def path(small_design):
    """The light of the small design."""
    return commands.light_path_in(small_design.folder)


@pytest.fixture(scope="module")
def light(path):
    """Return the light that a page is given."""
    return json.loads(rendering.turnable(lens(Plane(15.0), OUTLINES[0]), path))


def tones(url):
    """The pixels of a picture that a page holds."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))))


def test_rays_that_are_told_are_some_of_all_and_end_on_the_wall(light, path, small_scene):
    rays, flux, (wall,) = np.array(light["rays"]), np.array(light["flux"]), light["screens"]
    assert 50 < len(rays) <= rendering.MAX_MODEL_RAYS and len(flux) == len(rays)
    apart = np.abs(rays[:, None] - path.rays[None]).max(axis=(2, 3))
    assert apart.min(axis=1).max() <= 0.51e-4  # mm, by rounding
    whole = path.flux[apart.argmin(axis=1)] / path.flux.max()
    np.testing.assert_allclose(flux, whole, atol=0.51e-3)
    assert rays[:, -1, 2] == pytest.approx(small_scene.target.z, abs=1e-4)
    np.testing.assert_allclose(wall["corners"], path.screens[0], atol=0.51e-4)
    assert (tones(wall["picture"]) == path.pictures[0]).all()
    assert light["lamp"] == [list(small_scene.source.position)]
    spread = np.ptp(rays[:, 1, :2], axis=0) / np.ptp(path.rays[:, 1, :2], axis=0)
    assert (spread > 0.85).all()  # from all over the lens


@pytest.mark.parametrize("seen_along", [1, -1])
@pytest.mark.parametrize("off", [-300.0, 300.0])
def test_the_eye_is_on_the_side_that_shows_the_picture_and_not_behind_the_wall(path, off, seen_along):
    shifted = replace(
        path, screens=(path.screens[0] + [off, 0, 0], *path.screens), pictures=path.pictures * 2, seen_along=seen_along
    )
    light = json.loads(rendering.turnable(lens(Plane(15.0), OUTLINES[0]), shifted))
    x, y, z = light["aside"]
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(1) and y > 0
    assert x * off < 0 and z * seen_along < 0
    assert [screen["corners"][0][0] for screen in light["screens"]] == [shifted.screens[0][0, 0], path.screens[0][0, 0]]


def test_a_preview_is_coarse_and_small(path):
    made = lens(Sphere(15.0, 0.03), OUTLINES[0])
    assert read(rendering.turnable(made, path, 96))[0][0].shape[1] == 97
    assert len(rendering.turnable(made, path, 96)) < 0.35 * len(rendering.turnable(made, path))
