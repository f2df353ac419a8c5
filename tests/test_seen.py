"""The letter F, read on a wall by a person at the lens.

Nothing here trusts where the program says a pixel is: rays are traced through the lens, and where they land is looked
at by a person of flesh, who has a place, a line of sight and a head that is up.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from bstcad.optics.receivers.receivers import LevelPlane
from bstcad.optics.surfaces.rays import Status
from bstcad.optics.trace.trace import trace
from bstcad.scene.scene import load
from tests.efforts import designed_quickly

SIDE = 24  # number of pixels a side that the person makes out
RAYS = 500  # each way
GEOMETRY = {  # changes of the scene: everything on one axis; the wall as large as an arm
    "name": "f",
    "lens.back.control_points": 33,
    "lens.outline": {"shape": "rectangle", "width": 20.0, "height": 20.0},
    "source.aperture": {"shape": "rectangle", "width": 20.0, "height": 20.0},
    "target.z": 320.0,
    "target.x": [-12.0, 28.0],
    "target.y": [-20.0, 20.0],
    "target.pixels": 48,
    "tailoring.quality": "draft",
    "tailoring.rays": 192,
    "tailoring.rounds": 3,
    "tailoring.transport_grid": 64,
    "tailoring.stage2_iterations": 40,
}
VIEWERS = {"lens": (0.0, 0.0, 1.0), "behind": (0.0, 0.0, -1.0)}  # directions in which each viewer looks


def letter() -> np.ndarray:
    """An F, upright and unmirrored, drawn by hand; row 0 its top, column 0 its left."""
    picture = np.full((SIDE, SIDE), 20, np.uint8)
    picture[3:21, 7:10] = picture[3:6, 7:18] = picture[10:13, 7:15] = 255
    return picture


def seen_by(looks: tuple[float, float, float], points: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """(SIDE, SIDE) light of points (n, 3) in mm on a wall between two corners (2, 3), as a person sees it, head up."""
    up = np.array([0.0, 1.0, 0.0])
    right = np.cross(looks, up)
    across, down = (np.sort(corners @ axis) for corners, axis in ((wall, right), (wall, -up)))
    found, _, _ = np.histogram2d(points @ -up, points @ right, bins=SIDE, range=(down, across))
    return found


def likeness(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.corrcoef(found.ravel(), wanted.astype(float).ravel())[0, 1])


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The scene of an F for each of the two, by who sees it."""
    folder = tmp_path_factory.mktemp("seen")
    Image.fromarray(letter()).save(folder / "F.png")
    changes = {"target.image": str(folder / "F.png"), "target.gamma": 1.0}
    template = "templates/caustic_letters.toml"
    return {name: load(template, GEOMETRY | changes | {"target.seen_from": name}) for name in VIEWERS}


def test_the_person_meant_reads_an_f_and_the_other_one_its_mirror_image(scenes):
    scene = scenes["lens"]
    lens = designed_quickly(scene).lens
    line = (torch.arange(RAYS, dtype=torch.float64) + 0.5) * 20.0 / RAYS - 10.0
    x, y = torch.meshgrid(line, line, indexing="ij")
    landed = trace(scene.source.rays_through(x, y, lens.front.z, 1.0), lens, LevelPlane(320.0))
    arrived = (landed.status == Status.ALIVE).flatten()
    points = np.stack([*landed.position.flatten(1)[:, arrived].numpy(), np.full(int(arrived.sum()), 320.0)], axis=1)
    assert len(points) > 0.95 * RAYS**2
    corners, upright = np.array([[-12.0, -20.0, 320.0], [28.0, 20.0, 320.0]]), letter()
    found, mirrored = (seen_by(VIEWERS[name], points, corners) for name in ("lens", "behind"))
    others = [np.rot90(turned, k) for turned in (upright, upright[:, ::-1]) for k in range(4)][1:]
    assert likeness(found, upright) > 0.9 and max(likeness(found, other) for other in others) < 0.7
    assert likeness(mirrored, upright[:, ::-1]) > 0.9


def test_the_target_of_the_one_is_the_mirror_image_of_the_others(scenes):
    lens, behind = (scenes[name].target.irradiance() for name in VIEWERS)
    assert np.array_equal(behind, lens[:, ::-1]) and not np.array_equal(behind, lens)
