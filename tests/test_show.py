"""`bstcad show`: what is drawn is the light of the written design, and what cannot be shown is one sentence."""

import numpy as np
import pytest
from PIL import Image

from bstcad import cli, commands
from bstcad.figures import rendering
from bstcad.figures.figure_jobs import MILLIONTHS, corners
from bstcad.optics.receivers.irradiance import Screen
from tests import suite


@pytest.fixture(scope="module")
def shown(small_design):
    """Return the scene of `bstcad show` for the small design."""
    return commands.light_path_in(small_design.folder)


def said(capsys, *arguments):
    """(exit code, stderr) of a command line."""
    code = cli.run([str(argument) for argument in arguments])
    return code, capsys.readouterr().err


def test_rays_go_from_the_lamp_over_both_faces_to_the_screen_and_carry_the_light(shown, small_design, small_scene):
    lamp, front, back, landed = shown.rays.transpose(1, 0, 2)
    assert np.ptp(lamp, axis=0).max() == 0 and shown.lamp.tolist() == [list(small_scene.source.position)]
    assert (lamp[:, 2] < front[:, 2]).all() and (front[:, 2] < back[:, 2]).all()
    assert landed[:, 2] == pytest.approx(small_scene.target.z, abs=1e-9)
    arrives = sum(small_design.report["flux"][f"{side} target"] for side in ("on", "off"))
    assert shown.flux.sum() / MILLIONTHS == pytest.approx(arrives, rel=0.05)  # as well as so few cells tell it


def test_where_rays_land_the_picture_is_lit(shown):
    """The corners between which the picture is drawn neither turn nor mirror it against the rays."""
    (rows, columns), landed = shown.pictures[0].shape, shown.rays[:, -1]
    [screen] = shown.screens
    corner, along_x, along_y = screen[3], screen[2] - screen[3], screen[0] - screen[3]
    across, down = ((landed - corner) @ axis / (axis @ axis) for axis in (along_x, along_y))
    at = (np.clip(p * n, 0, n - 1).astype(int) for p, n in ((down, rows), (across, columns)))
    assert (shown.pictures[0][tuple(at)] > 128).mean() > 0.9 and (shown.pictures[0] > 128).mean() < 0.7


def test_corners_of_a_tilted_screen_lie_on_its_plane():
    level, tilted = (Screen(50.0, (10.0, 30.0), (-5.0, 5.0), 8, tilt) for tilt in (None, (20.0, -10.0)))
    assert corners(level).tolist() == [[10, -5, 50], [30, -5, 50], [30, 5, 50], [10, 5, 50]]
    found = corners(tilted)
    assert [tilted.receiver.height(tuple(corner)) for corner in found] == pytest.approx([0] * 4, abs=1e-12)
    assert np.linalg.norm(found - np.roll(found, 1, axis=0), axis=1) == pytest.approx([10, 20, 10, 20])


@suite.in_turn(0, 2)
def test_the_picture_has_the_screen_the_lens_and_the_rays(small_design, tmp_path, capsys):
    code, err = said(capsys, "show", small_design.folder, "--png", tmp_path / "light.png")
    if code:
        assert "cannot draw in three dimensions" in err
        pytest.skip("this machine cannot draw in 3-D")
    pixels = np.asarray(Image.open(tmp_path / "light.png").convert("RGB")).astype(int)
    assert pixels.shape == (*rendering.WINDOW[::-1], 3)
    right = np.arange(pixels.shape[1]) > pixels.shape[1] * rendering.VIEW_WIDTHS[0] / sum(rendering.VIEW_WIDTHS)
    assert 1e-3 < ((pixels.min(axis=2) > 100) & right).mean() < 0.1  # the lit disc, through rays before it
    warm = (pixels[..., 0] - pixels[..., 2] > 60) & (pixels[..., 0] > 90)
    assert warm[:, ~right].mean() > 0.02 and warm[:, right].mean() > 0.02  # rays, in both views
    assert (np.abs(pixels - pixels[5, 5]).max(axis=2) < 8).mean() > 0.3  # before a quiet ground


def test_what_cannot_be_shown_is_one_sentence(small_design, tmp_path, capsys, monkeypatch):
    folder = small_design.folder
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(commands.sys, "platform", "linux")
    (tmp_path / "empty").mkdir()
    for arguments, words in (
        ((folder,), "no display for a window; give --png FILE"),
        ((tmp_path / "none",), "no such folder"),
        ((tmp_path / "empty", "--png", tmp_path / "a.png"), "scene.toml"),
        ((folder, "--png", tmp_path / "a.jpg"), "is not the name of a PNG file"),
        ((folder, "--png", tmp_path / "none" / "a.png"), "create it first"),
    ):
        code, err = said(capsys, "show", *arguments)
        assert code == 2 and words in err and err.count("\n") == 1
    monkeypatch.setattr(rendering, "draw", lambda path, picture: False)
    assert said(capsys, "show", folder, "-o", tmp_path / "a.png")[0] == 2
    monkeypatch.setenv("DISPLAY", ":77")
    assert "give --png FILE" in said(capsys, "show", folder)[1]
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
