"""Intensity files of lamps: the light of a scene with one, its flux, orientation and copy."""

from __future__ import annotations

import math
import pickle
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

import bstcad
from bstcad.optics.surfaces import sampling
from bstcad.optics.surfaces.outlines import Rectangle
from bstcad.photometry import eulumdat, ies, tm25
from bstcad.photometry.intensity import Luminaire, checked
from bstcad.photometry.ray_set import RaySet
from bstcad.planning.preview import preview
from bstcad.planning.reduction import Reduction
from bstcad.scene import lamp
from bstcad.scene.errors import SceneError


def table():
    """A cone of 30 degrees about γ = 20, C = 30."""
    planes, along = np.arange(0.0, 360.0, 5.0), np.linspace(0.0, 90.0, 37)
    c, g = np.radians(planes)[:, None], np.radians(along)[None]
    aim = math.sin(math.radians(20)), math.radians(30)
    cos = aim[0] * np.sin(g) * np.cos(c - aim[1]) + math.cos(math.radians(20)) * np.cos(g)
    return checked("C", planes, along, 500 * np.exp(-((np.arccos(np.clip(cos, -1, 1)) / math.radians(30)) ** 2)), None)


@pytest.fixture(params=["lamp.ies", "lamp.ldt"])
def scene(request, tmp_path):
    write = ies.write if request.param.endswith("ies") else eulumdat.write
    (tmp_path / request.param).write_bytes(write(table(), Luminaire()))
    changes = {
        "source": {"kind": "point", "intensity": str(tmp_path / request.param), "position": [0.0, 0.0, -20.0]},
        "target.uniform": True,
    }
    return bstcad.load("templates/disk.toml").changed(changes)


def test_the_light_of_a_lamp_is_the_file_s(scene, tmp_path):
    """Intensities by the irradiance on a plane, E d³ / D; C from x towards -y; flux by the file's own integral."""
    source, given = scene.source, table()
    assert source.luminous_flux == pytest.approx(given.lumens, rel=1e-4)
    assert f"{given.lumens:.4g}"[:4] in source.words(0.0)
    for c, g in ((30.0, 20.0), (120.0, 10.0), (270.0, 45.0), (0.0, 0.0)):
        x, y = (20 * math.tan(math.radians(g)) * p for p in (math.cos(math.radians(c)), -math.sin(math.radians(c))))
        light = float(source.irradiance(torch.tensor(x).double(), torch.tensor(y).double(), 0.0))
        d = math.hypot(x, y, 20.0)
        assert light * d**3 / 20 * source.luminous_flux == pytest.approx(
            given.between(np.array(c), np.array(g)), rel=0.01
        )
    x, y = sampling.grid(Rectangle(1200.0, 1200.0), 2000)
    assert float(source.irradiance(x, y, 0.0).sum()) * (1200 / 2000) ** 2 == pytest.approx(1, abs=0.003)
    again = bstcad.load(saved(scene, tmp_path / "copy"))
    assert torch.equal(again.source.irradiance(x, y, 0.0), source.irradiance(x, y, 0.0))


def saved(scene, folder):
    folder.mkdir()
    (folder / "scene.toml").write_text(scene.toml(), encoding="utf-8")
    for name, content in scene.files.items():
        (folder / name).write_bytes(content.copy)
    return folder / "scene.toml"


def test_a_rotation_turns_the_light_about_the_axis(scene):
    turned = scene.changed({"source.rotate": 90.0}).source
    x, y = torch.tensor([5.0, 3.0]).double(), torch.tensor([-2.0, 4.0]).double()
    torch.testing.assert_close(turned.irradiance(-y, x, 0.0), scene.source.irradiance(x, y, 0.0), rtol=2e-3, atol=0)


def test_wrong_intensities_are_refused(scene, tmp_path):
    (tmp_path / "bad.ies").write_bytes(b"IESNA:LM-63-2002\nTILT=NONE\n1 -1 1 3 1 1 2 0 0 0\n1 1 10\n0 45 90\n0\n1 1\n")
    with pytest.raises(SceneError, match=r"^source\.intensity: 'bad.ies' ends after .* not complete"):
        scene.changed({"source.intensity": str(tmp_path / "bad.ies")})
    with pytest.raises(SceneError, match=r"^source\.intensity: .* cannot be read"):
        scene.changed({"source.intensity": str(tmp_path / "none.ies")})
    with pytest.raises(SceneError, match=r"^source\.profile: the source also has an intensity"):
        scene.changed({"source.profile": "uniform", "source.half_angle": 20.0})


def test_a_lamp_above_a_mirror_is_turned_not_mirrored(scene):
    """C = 90 degrees points along +y for light along -z, and rotate still turns from x towards y."""
    source = scene.source
    above = replace(source, position=(0.0, 0.0, 20.0))
    x, y = torch.tensor([5.0, 3.0]).double(), torch.tensor([-2.0, 4.0]).double()
    torch.testing.assert_close(above.irradiance(x, -y, 0.0), source.irradiance(x, y, 0.0), rtol=1e-9, atol=0)
    turned = replace(above, rotate=90.0)
    torch.testing.assert_close(turned.irradiance(-y, x, 0.0), above.irradiance(x, y, 0.0), rtol=2e-3, atol=0)


def test_a_target_of_directions_is_changed_and_written(scene, tmp_path):
    """The kind of a target may be changed; the file of an intensity has the orientation of its own."""
    wanted = {"kind": "intensity", "x": [-40.0, 40.0], "y": [-30.0, 30.0], "pixels": 32}
    over = scene.changed({"target": wanted | {"text": "L"}})
    assert over.target.unit == "degrees" and "\nz = " not in over.toml().partition("[target]")[2].partition("[")[0]
    assert bstcad.load(saved(over, tmp_path / "over")) == over
    plane = over.changed({"target.kind": "plane", "target.z": 500.0, "target.angles": None})
    assert plane.target.screen.receiver.is_level
    with pytest.raises(SceneError, match=r"^target\.z: "):
        over.changed({"target.kind": "plane", "target.angles": None})
    file = str(tmp_path / "wanted.ldt")
    (tmp_path / "wanted.ldt").write_bytes(eulumdat.write(table(), Luminaire()))
    shown = scene.changed({"target": wanted | {"intensity": file}})
    light = shown.target.irradiance() / shown.target.screen.areas
    row, column = np.unravel_index(light.argmax(), light.shape)
    columns, rows = shown.target.columns_rows
    x, y = 80 * (column + 0.5) / columns - 40, 30 - 60 * (row + 0.5) / rows
    assert math.degrees(math.atan2(-y, x)) % 360 == pytest.approx(30, abs=8)
    for key, value in {"rotate": 90, "mirror": True, "seen_from": "behind", "invert": True}.items():
        with pytest.raises(SceneError, match=rf"^target\.{key}: the file of an intensity has an orientation"):
            scene.changed({"target": wanted | {"intensity": file, key: value}})
    with pytest.raises(SceneError, match=r"^target\.x: a corner of the target is more than 180 degrees"):
        scene.changed({"target": wanted | {"text": "L", "x": [-150.0, 150.0], "y": [-150.0, 150.0]}})


def rays_of(n=3000, up=True):
    """Rays of a disc of 2 mm into a cone about the axis."""
    chance = np.random.default_rng(3)
    radius, turn = np.sqrt(chance.random(n)), 2 * np.pi * chance.random(n)
    start = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], 1)
    direction = np.hstack([0.3 * chance.standard_normal((n, 2)), np.full((n, 1), 1.0 if up else -1.0)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    power = np.full(n, 50.0 / n, np.float32)
    return RaySet(start.astype(np.float32), direction.astype(np.float32), power, "lm")


@pytest.fixture
def ray_scene(tmp_path):
    (tmp_path / "led.tm25ray").write_bytes(tm25.write(rays_of(), Luminaire()))
    source = {"kind": "point", "rays": str(tmp_path / "led.tm25ray"), "position": [0.0, 0.0, -20.0]}
    return bstcad.load("templates/disk.toml").changed({"source": source, "target.uniform": True})


def test_rays_give_size_flux_and_light_and_are_copied(ray_scene, tmp_path):
    source = ray_scene.source
    assert source.luminous_flux == pytest.approx(50.0, rel=1e-6)
    assert source.extent.is_round and source.extent.radius == pytest.approx(1.0, rel=0.05)
    assert source.emission_centre() == pytest.approx(
        (0.0, 0.0, -20.0), abs=0.1
    ) and "3000 rays of led.tm25ray" in source.words(0)
    again = bstcad.load(saved(ray_scene, tmp_path / "copy"))
    assert again == ray_scene and again.sampler.largest_side == ray_scene.sampler.largest_side
    [one], [other] = (scene.sampler(8, 5) for scene in (ray_scene, again))
    assert np.array_equal(one.source.order.order, other.source.order.order) and one.source.part == other.source.part
    assert ray_scene.changed({"source.lumens": 70.0}).source.luminous_flux == 70.0
    assert not any("rays" in doubt for doubt in ray_scene.warnings())
    (tmp_path / "other.tm25ray").write_bytes(tm25.write(rays_of(), Luminaire())[:12] + struct.pack("<f", 80.0)
                                             + tm25.write(rays_of(), Luminaire())[16:])  # fmt: skip
    scaled = ray_scene.changed({"source.rays": str(tmp_path / "other.tm25ray")})
    assert scaled.source.luminous_flux == pytest.approx(80.0, rel=1e-6)
    assert any(doubt.startswith("source.rays: The powers of the rays sum to 50 lm") for doubt in scaled.warnings())


def test_a_default_of_the_effects_is_not_stated_by_a_saved_scene(ray_scene, tmp_path):
    """Fresnel losses follow the flux, before and after saving, unless the scene states its effects."""
    again = bstcad.load(saved(ray_scene, tmp_path / "copy"))
    for scene in (ray_scene, again):
        assert [effect.kind for effect in scene.effects] == ["fresnel"] and "effects" not in scene.toml()
        assert scene.changed({"source": {"kind": "point"}}).effects == ()
    stated = ray_scene.changed({"effects": []})
    assert "effects = []" in stated.toml() and stated.effects == ()


def test_a_lamp_whose_rays_start_at_a_point_has_a_preview(ray_scene, tmp_path):
    rays = replace(rays_of(20_000), position=np.zeros((20_000, 3), np.float32))
    (tmp_path / "point.tm25ray").write_bytes(tm25.write(rays, Luminaire()))
    scene = ray_scene.changed({"source.rays": str(tmp_path / "point.tm25ray")})
    assert scene.source.extent is None and scene.sampler is not None
    seen = preview(scene, Reduction(pixels=24, net=17, cells=48, tubes=36, rounds=1, evaluations=2, blurred=1))
    assert all(np.isfinite(picture).all() for pictures in seen.pictures for picture in pictures)


def test_a_lamp_beside_the_lens_is_measured_and_not_refused():
    beside = {"source.profile": "uniform", "source.half_angle": 5.0, "source.position": [50.0, 0.0, 0.0]}
    bstcad.load("templates/disk.toml").changed(beside)


def test_of_a_ray_file_too_large_for_a_copy_random_rays_are_copied(tmp_path, monkeypatch):
    path = tmp_path / "big.tm25ray"
    path.write_bytes(tm25.write(rays_of(), Luminaire()))
    monkeypatch.setattr("bstcad.scene.lamp.MAX_RAYS_SIZE", 1000)
    monkeypatch.setattr("bstcad.scene.lamp.COPIED_RAYS", 1500)
    found = lamp.read_rays(path)
    assert len(found.rays) == 1500 and found.lumens == pytest.approx(50.0, rel=1e-3) and len(found.data) < 90_000
    assert found.name == "rays-big.tm25ray" and "1500 random ones" in found.remarks[0]
    again = pickle.loads(pickle.dumps(found))
    assert again == found and len(pickle.dumps(found)) < 1.1 * len(found.data)
    assert np.array_equal(again.rays.power, found.rays.power)


def test_wrong_rays_are_refused(ray_scene, tmp_path):
    (tmp_path / "short.tm25ray").write_bytes(tm25.write(rays_of(), Luminaire())[:-1000])
    (tmp_path / "down.tm25ray").write_bytes(tm25.write(rays_of(up=False), Luminaire()))
    (tmp_path / "few.tm25ray").write_bytes(tm25.write(rays_of(20), Luminaire()))
    (tmp_path / "blue.tm25ray").write_bytes(tm25.write(replace(rays_of(), wavelength=450.0), Luminaire()))
    with pytest.raises(SceneError, match=r"^source\.wavelength: the file of the rays states"):
        ray_scene.changed({"source.rays": str(tmp_path / "blue.tm25ray"), "source.wavelength": 650.0})
    faults = {
        "short": "states 3000 rays .* not complete", "down": "has no ray along", "no": "cannot be",
        "few": "has 20 rays, .* at least 1000",
    }  # fmt: skip
    for name, fault in faults.items():
        with pytest.raises(SceneError, match=rf"^source\.rays: '.*{name}.tm25ray' {fault}"):
            ray_scene.changed({"source.rays": str(tmp_path / f"{name}.tm25ray")})
    for key, value in (("real_diameter", 2.0), ("diameter", 1.0), ("half_angle", 20.0)):
        with pytest.raises(SceneError, match=rf"^source\.{key}: the source also has rays"):
            ray_scene.changed({f"source.{key}": value})
