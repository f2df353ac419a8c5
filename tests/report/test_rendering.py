"""The 3-D picture: drawn where the machine can, None where it cannot, and never a crash or a line on the terminal."""

import io
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from bstcad.cad.mesh import Mesh
from bstcad.report import rendering

CUBE = trimesh.creation.box((24.0, 24.0, 10.0))
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


def test_a_renderer_that_dies_gives_no_picture(monkeypatch):
    monkeypatch.setattr(rendering.sys, "executable", shutil.which("false"))
    assert rendering.lens_picture(BOX) is None


def test_a_renderer_that_hangs_gives_no_picture(monkeypatch):
    monkeypatch.setattr(rendering, "PATIENCE", 0.01)
    assert rendering.lens_picture(BOX) is None
