"""Scenes by which predictions are fitted, and twelve others that they are held to.

Each is a template with other values; pictures are scikit-image's bundled ones, letters, and a few that are drawn here,
all as linear irradiance.  No picture, text or geometry of the kept-out scenes is among those of the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.scene.scene import Scene, load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
NO_PICTURE = {"target.text": None, "target.sample": None, "target.uniform": None}


@dataclass(frozen=True)
class Case:
    """A scene, and the qualities in which it is designed."""

    name: str
    template: str
    qualities: tuple[str, ...]
    picture: str = ""  # of scikit-image, or drawn here; "": the template's
    changes: Mapping[str, Any] = field(default_factory=dict)

    def scene(self, quality: str) -> Scene:
        """The scene in one of its qualities."""
        changes = {"name": f"{self.name}-{quality}", "tailoring.quality": quality} | dict(self.changes)
        if self.picture:
            changes["target.image"] = drawn(self.picture)
        return load(TEMPLATES / f"{self.template}.toml").changed(changes)


def drawn(name: str) -> np.ndarray:
    """(rows, columns) irradiance, row 0 the top."""
    y, x = np.mgrid[1:-1:512j, -1:1:512j]
    r = np.hypot(x, y)
    if name in PATTERNS:
        return PATTERNS[name](x, y, r)
    from skimage import data

    picture = np.asarray(getattr(data, name)(), dtype=float)
    return picture.mean(2) if picture.ndim == 3 else picture


PATTERNS = {
    "rings": lambda x, y, r: 1 + 0.6 * np.cos(14 * r),
    "checks": lambda x, y, r: np.where((np.floor(4 * x) + np.floor(4 * y)) % 2, 1.0, 0.15),
    "spots": lambda x, y, r: 0.05 + np.exp(4 * (np.cos(9 * x) * np.cos(9 * y) - 1)),
    "slope": lambda x, y, r: 0.1 + 0.9 * (x + 1) / 2,
    "ramp": lambda x, y, r: 0.2 + 0.8 * (y + 0.5 * x + 1.5) / 3,
    "glow": lambda x, y, r: 0.1 + np.exp(-3 * r**2),
    "wedge": lambda x, y, r: 0.15 + (np.arctan2(y, x) + np.pi) / (2 * np.pi) * np.clip(4 * r, 0, 1),
    "vignette": lambda x, y, r: 1 - 0.4 * r**2,
    # of the kept-out scenes
    "spiral": lambda x, y, r: 1 + 0.7 * np.cos(16 * r + 3 * np.arctan2(y, x)),
    "zone plate": lambda x, y, r: 0.1 + (np.cos(40 * r**2) > 0),
    "star": lambda x, y, r: np.where(r < 0.55 + 0.35 * np.cos(5 * np.arctan2(x, y)), 1.0, 0.05),
    "clouds": lambda x, y, r: np.exp(0.6 * _noise(len(x), -1.5)),
    "islands": lambda x, y, r: np.where(_noise(len(x), -2.0) > 0, 1.0, 0.1),
    "dusk": lambda x, y, r: np.exp(-1.5 * (y + 0.3 * x)),
    "faces": lambda x, y, r: np.block([[_face(4 * i + j) for j in range(4)] for i in range(4)]),
}


def _noise(side: int, power: float) -> np.ndarray:
    """Noise of mean 0 and variance 1, the amplitude of whose waves falls with a power of their number."""
    waves = np.fft.fft2(np.random.default_rng(7).standard_normal((side, side)))
    number = np.hypot(*np.meshgrid(*[np.fft.fftfreq(side, 1 / side)] * 2))
    waves[number > 0] *= number[number > 0] ** power
    waves[0, 0] = 0
    noise = np.fft.ifft2(waves).real
    return noise / noise.std()


def _face(number: int) -> np.ndarray:
    from skimage import data

    return data.lfw_subset()[number]


DRAFT, STANDARD, BOTH = ("draft",), ("standard",), ("draft", "standard")
NET, PIXELS = "lens.back.control_points", "target.pixels"

FIT = (
    Case("thu", "thu", BOTH),
    Case("portrait", "portrait", BOTH),
    Case("caustic-portrait", "caustic_portrait", BOTH),
    Case("caustic-letters", "caustic_letters", DRAFT),
    Case("off-axis", "off_axis", DRAFT),
    Case("disk", "disk", BOTH),
    Case("cat", "caustic_portrait", BOTH, "chelsea", {NET: 257, PIXELS: 256, "target.z": 140.0}),
    Case("coffee", "portrait", BOTH, "coffee", {NET: 129, PIXELS: 256, "target.z": 500.0}),
    Case("rings", "disk", BOTH, "rings", {NET: 129, PIXELS: 192, "target.outline": None, "target.uniform": None}),
    Case("rocket", "off_axis", DRAFT, "rocket", {NET: 257, PIXELS: 384}),
    Case("letters-by-point", "disk", BOTH, "", {NET: 257, PIXELS: 384, "target.outline": None, "target.text": "Ag"}),
    Case("brick", "caustic_portrait", STANDARD, "brick", {NET: 129, PIXELS: 512}),
    Case("grass", "caustic_portrait", DRAFT, "grass", {NET: 385, PIXELS: 512, "target.z": 1010.0}),
    Case("checks", "thu", DRAFT, "checks", {NET: 257, PIXELS: 256, "target.z": 2000.0}),
    Case("spots", "disk", DRAFT, "spots", {NET: 513, PIXELS: 256, "target.outline": None}),
    Case("slope", "thu", STANDARD, "slope", {NET: 129, PIXELS: 128, "target.x": (-100.0, 300.0)}),
    Case("fine-net", "caustic_portrait", DRAFT, "", {NET: 1025}),
    Case("cameraman", "caustic_portrait", STANDARD, "camera", {"target.z": 260.0}),
    Case("coins", "portrait", DRAFT, "coins", {NET: 257, PIXELS: 384, "target.z": 700.0}),
    Case("moon", "off_axis", DRAFT, "moon", {NET: 385, "target.z": 600.0, "target.x": (50.0, 350.0),
                                             "target.y": (-150.0, 150.0)}),
    Case("words", "caustic_letters", STANDARD, "", {"target.text": "bst\ncad", "target.z": 420.0}),
    Case("far-word", "disk", STANDARD, "", {NET: 257, PIXELS: 256, "target.z": 2500.0, "target.text": "Optik",
                                            "target.outline": None, "target.x": (-900.0, 900.0),
                                            "target.y": (-600.0, 600.0)}),
    Case("ramp", "disk", STANDARD, "ramp", {NET: 129, PIXELS: 128, "target.outline": None}),
    Case("page", "caustic_letters", DRAFT, "page", {NET: 1025, "target.fit": "crop"}),
    Case("handwriting", "thu", DRAFT, "text", {"target.x": (-200.0, 200.0)}),
    Case("clock", "portrait", STANDARD, "clock", {NET: 257, PIXELS: 256, "target.z": 1500.0}),
    Case("cell", "caustic_portrait", STANDARD, "cell", {NET: 129, PIXELS: 256, "target.z": 500.0}),
    Case("glow", "thu", DRAFT, "glow", {NET: 129, PIXELS: 256, "target.z": 350.0, "target.x": (-100.0, 100.0),
                                        "target.y": (-100.0, 100.0)}),
    Case("retina", "off_axis", DRAFT, "retina", {NET: 1025, "target.z": 2000.0, "target.x": (100.0, 900.0),
                                                 "target.y": (100.0, 900.0)}),
    Case("horse", "caustic_letters", STANDARD, "horse", {NET: 385, PIXELS: 384, "target.z": 310.0}),
    Case("tissue", "portrait", DRAFT, "immunohistochemistry", {PIXELS: 384, "target.z": 800.0}),
    Case("gravel", "off_axis", STANDARD, "gravel", {NET: 257, PIXELS: 256, "target.z": 1400.0,
                                                    "target.x": (0.0, 500.0), "target.y": (-250.0, 250.0)}),
    Case("galaxies", "caustic_portrait", DRAFT, "hubble_deep_field", {NET: 257, "target.z": 180.0}),
    Case("vessels", "thu", STANDARD, "microaneurysms", {NET: 257, PIXELS: 128, "target.z": 700.0}),
    Case("number", "disk", DRAFT, "", {NET: 385, PIXELS: 384, "target.outline": None, "target.text": "2048",
                                       "target.z": 900.0}),
    Case("initial", "caustic_portrait", STANDARD, "", {NET: 257, PIXELS: 256, "target.sample": None,
                                                       "target.text": "R", "target.z": 700.0}),
    Case("phantom", "disk", STANDARD, "shepp_logan_phantom", {NET: 129, PIXELS: 192, "target.outline": None}),
    Case("wedge", "caustic_letters", DRAFT, "wedge", {NET: 129, PIXELS: 192, "target.z": 600.0}),
    Case("vignette", "portrait", STANDARD, "vignette", {NET: 129, PIXELS: 192, "target.z": 400.0}),
    Case("sentence", "caustic_letters", DRAFT, "", {NET: 1025, "target.text": "light\nfollows\nform",
                                                    "target.z": 150.0}),
    Case("wheel", "thu", DRAFT, "colorwheel", {NET: 1025, "target.z": 1600.0}),
)  # fmt: skip

KEPT_OUT = (
    Case("spiral", "disk", STANDARD, "spiral", {NET: 257, PIXELS: 256, "target.outline": None, "target.z": 600.0}),
    Case("zone-plate", "thu", DRAFT, "zone plate", {NET: 385, PIXELS: 384, "target.z": 1300.0}),
    Case("star", "caustic_letters", STANDARD, "star", {NET: 129, PIXELS: 256, "target.z": 220.0}),
    Case("clouds", "off_axis", DRAFT, "clouds", {NET: 1025, "target.z": 1200.0, "target.x": (-50.0, 450.0),
                                                 "target.y": (-250.0, 250.0)}),
    Case("dusk", "portrait", STANDARD, "dusk", {NET: 129, PIXELS: 128, "target.z": 350.0}),
    Case("faces", "caustic_portrait", STANDARD, "faces", {NET: 385, PIXELS: 384, "target.z": 450.0}),
    Case("chess", "off_axis", STANDARD, "checkerboard", {NET: 257, PIXELS: 192, "target.z": 900.0}),
    Case("logo", "portrait", DRAFT, "logo", {NET: 257, PIXELS: 320, "target.z": 900.0}),
    Case("islands", "caustic_letters", DRAFT, "islands", {NET: 257, PIXELS: 256, "target.z": 900.0}),
    Case("sign", "disk", DRAFT, "", {PIXELS: 512, "target.outline": None, "target.text": "EXIT", "target.z": 1800.0,
                                     "target.x": (-500.0, 500.0), "target.y": (-500.0, 500.0)}),
    Case("year", "thu", STANDARD, "", {NET: 257, PIXELS: 256, "target.text": "1905", "target.z": 3000.0}),
    Case("poem", "caustic_portrait", DRAFT, "", {NET: 1025, "target.sample": None, "target.z": 350.0,
                                                 "target.text": "more\nlight\non paper"}),
)  # fmt: skip
