"""Four tiles of a plate of 300 mm: valid solids, whose volumes and light add up to those of the plate."""

import pytest
import torch

import bstcad
from bstcad.cad import solid_properties
from bstcad.cad.tiles import tiles_of
from bstcad.cad.tiling import Tiling
from bstcad.optics.lens.face_integrals import of_lens
from bstcad.optics.receivers.irradiance import collect
from bstcad.optics.trace.trace import trace
from tests.cad.test_tiles import light_of_tile, rays_over, reread, rms

pytestmark = pytest.mark.bench

SIDE = 300.0  # mm
PLATE = {
    "source.aperture": {"shape": "rectangle", "width": SIDE, "height": SIDE},
    "lens.outline": {"shape": "rectangle", "width": SIDE, "height": SIDE},
    "lens.back.z": 15.0,
    "target.z": 1500.0,
    "target.x": [-200.0, 200.0],
    "target.y": [-200.0, 200.0],
    "target.pixels": 128,
    "tailoring.quality": "draft",
}
RAYS = 1500  # rays per side


def test_four_tiles_of_a_large_plate(tmp_path):
    scene = bstcad.load("templates/sun_caustic.toml").changed(PLATE)
    lens = bstcad.design(scene, progress=False).lens.plain()
    source, screen = scene.light.central, scene.target.screen
    whole, other = (
        collect(trace(source.rays_through(x, y, lens.front.z, area), lens, screen.receiver), screen)[0]
        for x, y, area in (rays_over(lens.outline, RAYS, seed) for seed in (1, 2))
    )
    volume, light = 0.0, torch.zeros_like(whole)
    for k, tile in enumerate(tiles_of(lens, Tiling(2, 2))):
        solid, _ = reread(tile, tmp_path / "tile.step")
        volume += solid_properties.of_solid(solid).volume
        start = rays_over(lens.outline, RAYS, 10 + k)
        light += light_of_tile(tile, lens, tmp_path / "tile.step", source, screen, start)
    off, noise = rms(light - whole, whole.mean()), rms(other - whole, whole.mean())
    print(f"volumes: {volume / of_lens(lens).volume - 1:.1e}; light: {off:.4f} of the mean, noise {noise:.4f}")
    assert volume == pytest.approx(of_lens(lens).volume, rel=1e-6)
    assert off < 1.25 * noise
