"""Scenes by which predictions are fitted, and fourteen others that they are held to.

Each is a template with other values; pictures are scikit-image's bundled ones, letters, and some that are drawn
(prediction_pictures.py), all as linear irradiance.  No picture, text or geometry of the kept-out scenes is among those
of the fit.  Once their predictions have been looked at, they go to the fit, and others take their place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bstcad.scene.scene import Scene, load
from tests.benchmarks.cold import TEMPLATES
from tests.benchmarks.prediction_pictures import drawn


@dataclass(frozen=True)
class Case:
    """A scene, and the qualities in which it is designed."""

    name: str
    template: str
    qualities: tuple[str, ...]
    picture: str = ""  # of prediction_pictures.py; "": the template's
    changes: Mapping[str, Any] = field(default_factory=dict)

    def scene(self, quality: str) -> Scene:
        """The scene in one of its qualities."""
        changes = {"name": f"{self.name}-{quality}", "tailoring.quality": quality} | dict(self.changes)
        if self.picture:
            changes["target.image"] = drawn(self.picture)
        return load(TEMPLATES / f"{self.template}.toml").changed(changes)


DRAFT, STANDARD, BOTH, ALL = ("draft",), ("standard",), ("draft", "standard"), ("draft", "standard", "fine")
NET, PIXELS = "lens.back.control_points", "target.pixels"
X, Y, Z, TEXT, OUTLINE, SAMPLE = (f"target.{key}" for key in ("x", "y", "z", "text", "outline", "sample"))

DIAMETER = "source.diameter"
PLAIN = {"effects": (), "tailoring.rays": None}  # of the LED's scene: no losses, tubes as the quality has them


def square(half: float) -> dict[str, tuple[float, float]]:
    """A target from -half to half mm in x and in y."""
    return {X: (-half, half), Y: (-half, half)}


FIT = (
    Case("thu", "thu", ALL),
    Case("portrait", "portrait", ALL),
    Case("caustic-portrait", "caustic_portrait", BOTH),
    Case("caustic-letters", "caustic_letters", BOTH),
    Case("off-axis", "off_axis", BOTH),
    Case("disk", "disk", BOTH),
    Case("cat", "caustic_portrait", BOTH, "chelsea", {NET: 257, PIXELS: 256, Z: 140.0}),
    Case("coffee", "portrait", BOTH, "coffee", {NET: 129, PIXELS: 256, Z: 500.0}),
    Case("rings", "disk", BOTH, "rings", {NET: 129, PIXELS: 192, OUTLINE: None, "target.uniform": None}),
    Case("letters-by-point", "disk", BOTH, "", {NET: 257, PIXELS: 384, OUTLINE: None, TEXT: "Ag"}),
    Case("brick", "caustic_portrait", STANDARD, "brick", {NET: 129, PIXELS: 512}),
    Case("grass", "caustic_portrait", DRAFT, "grass", {NET: 385, PIXELS: 512, Z: 1010.0}),
    Case("checks", "thu", DRAFT, "checks", {NET: 257, PIXELS: 256, Z: 2000.0}),
    Case("spots", "disk", DRAFT, "spots", {NET: 513, PIXELS: 256, OUTLINE: None}),
    Case("slope", "thu", STANDARD, "slope", {NET: 129, PIXELS: 128, X: (-100.0, 300.0)}),
    Case("fine-portrait", "portrait", STANDARD, "", {NET: 1025}),
    Case("coins", "portrait", DRAFT, "coins", {NET: 257, PIXELS: 384, Z: 700.0}),
    Case("words", "caustic_letters", STANDARD, "", {TEXT: "bst\ncad", Z: 420.0}),
    Case("ramp", "disk", STANDARD, "ramp", {NET: 129, PIXELS: 128, OUTLINE: None}),
    Case("handwriting", "thu", DRAFT, "text", {X: (-200.0, 200.0)}),
    Case("cell", "caustic_portrait", STANDARD, "cell", {NET: 129, PIXELS: 256, Z: 500.0}),
    Case("retina", "off_axis", DRAFT, "retina", {NET: 1025, Z: 2000.0, X: (100.0, 900.0),
                                                 Y: (100.0, 900.0)}),
    Case("galaxies", "caustic_portrait", DRAFT, "hubble_deep_field", {NET: 257, Z: 180.0}),
    Case("phantom", "disk", STANDARD, "shepp_logan_phantom", {NET: 129, PIXELS: 192, OUTLINE: None}),
    Case("vignette", "portrait", ("standard", "fine"), "vignette", {NET: 129, PIXELS: 192, Z: 400.0}),
    Case("clouds", "off_axis", DRAFT, "clouds", {NET: 1025, Z: 1200.0, X: (-50.0, 450.0),
                                                 Y: (-250.0, 250.0)}),
    Case("faces", "caustic_portrait", STANDARD, "faces", {NET: 385, PIXELS: 384, Z: 450.0}),
    Case("bust", "portrait", STANDARD, "bust", {NET: 257, PIXELS: 320, Z: 650.0}),
    Case("contours", "caustic_portrait", ("fine",), "contours", {NET: 385, PIXELS: 256, Z: 380.0}),
    Case("matrix-code", "caustic_letters", DRAFT, "matrix code", {NET: 1025, Z: 280.0}),
    Case("boat", "caustic_letters", DRAFT, "line drawing", {PIXELS: 384, Z: 520.0}),
    Case("greeting", "caustic_portrait", DRAFT, "", {NET: 257, PIXELS: 320, SAMPLE: None, Z: 200.0,
                                                     TEXT: "Grüße\naus\nUlm"}),
    Case("stripes", "caustic_portrait", STANDARD, "stripes", {NET: 385, PIXELS: 320, Z: 330.0}),
    Case("corner", "thu", STANDARD, "corner", {NET: 257, PIXELS: 256, Z: 1700.0}),
    Case("swirl", "off_axis", DRAFT, "swirl", {NET: 385, PIXELS: 320, Z: 1250.0}),
    Case("zebra", "caustic_letters", STANDARD, "", {NET: 129, PIXELS: 256, TEXT: "zebra", Z: 250.0}),
    Case("blobs-aside", "off_axis", STANDARD, "blobs", {NET: 257, PIXELS: 384, Z: 1100.0}),
    Case("marble", "thu", STANDARD, "marble", {NET: 385, PIXELS: 320, Z: 900.0}),
    Case("many-strokes", "disk", DRAFT, "many strokes", {NET: 513, PIXELS: 512, OUTLINE: None, Z: 900.0}),
    Case("dots", "portrait", DRAFT, "dots", {NET: 257, PIXELS: 320, Z: 600.0}),
    Case("bullseye", "portrait", DRAFT, "bullseye", {NET: 1025, PIXELS: 512, Z: 900.0}),
    Case("folds", "disk", STANDARD, "folds", {NET: 385, PIXELS: 384, OUTLINE: None, Z: 1300.0}),
    Case("window", "portrait", STANDARD, "window", {NET: 385, PIXELS: 320, Z: 1100.0}),
    Case("astronaut", "portrait", STANDARD, "astronaut", {Z: 900.0}),
    Case("terrain", "caustic_portrait", DRAFT, "terrain", {NET: 385, PIXELS: 384, Z: 360.0}),
    Case("coast", "thu", STANDARD, "coast", {NET: 1025, PIXELS: 320, Z: 1100.0}),
    Case("cog", "disk", STANDARD, "cog", {NET: 257, PIXELS: 256, OUTLINE: None, Z: 750.0}),
    Case("sunset", "off_axis", STANDARD, "sunset", {NET: 257, PIXELS: 320, Z: 1700.0}),
    Case("julia", "thu", DRAFT, "julia", {NET: 1025, PIXELS: 512, Z: 1050.0}),
    Case("distress", "portrait", STANDARD, "", {NET: 129, PIXELS: 256, SAMPLE: None, TEXT: "SOS", Z: 1000.0}),
    Case("led", "led", BOTH, "", PLAIN),
    Case("led-ramp", "led", BOTH, "ramp", PLAIN | {NET: 129, PIXELS: 128, "target.uniform": None}),
    Case("led-glow", "led", DRAFT, "glow", PLAIN | {NET: 257, PIXELS: 256, "target.uniform": None, Z: 700.0}),
    Case("led-faces", "led", STANDARD, "faces", PLAIN | {NET: 129, PIXELS: 192, "target.uniform": None, DIAMETER: 0.2}),
    Case("sun-caustic", "sun_caustic", BOTH),
    Case("sun-letters", "sun_caustic", STANDARD, "", {SAMPLE: None, TEXT: "SUN", Z: 600.0, "source.divergence": 0.2}),
    Case("sun-swirl", "sun_caustic", DRAFT, "swirl", {NET: 513, PIXELS: 384, Z: 200.0, "source.divergence": 0.1}),
    Case("sun-coins", "sun_caustic", STANDARD, "coins", {NET: 129, PIXELS: 192, Z: 150.0}),
    Case("mirror", "mirror", BOTH),
    Case("mirror-letters", "mirror", STANDARD, "", {NET: 257, PIXELS: 320, SAMPLE: None, TEXT: "ab\ncd", Z: 900.0}),
    Case("mirror-clouds", "mirror", DRAFT, "clouds", {NET: 385, PIXELS: 384}),
    Case("mirror-hills", "mirror", STANDARD, "hills", {NET: 129, PIXELS: 256, Z: 1200.0}),
    Case("ripple", "portrait", STANDARD, "ripple", {NET: 257, PIXELS: 320, Z: 1100.0}),
    Case("weave", "caustic_portrait", DRAFT, "weave", {NET: 385, PIXELS: 320, Z: 240.0}),
    Case("crescent", "off_axis", STANDARD, "crescent", {NET: 385, PIXELS: 384, Z: 950.0}),
    Case("nebula", "thu", DRAFT, "nebula", {NET: 257, PIXELS: 256, Z: 1900.0}),
    Case("lakes", "disk", STANDARD, "lakes", {PIXELS: 384, OUTLINE: None, Z: 1000.0}),
    Case("grid", "portrait", DRAFT, "grid", {PIXELS: 448, Z: 950.0}),
    Case("comet", "caustic_letters", STANDARD, "comet", {NET: 129, PIXELS: 192, Z: 340.0}),
    Case("saddle", "off_axis", DRAFT, "saddle", {NET: 129, PIXELS: 128, Z: 1400.0}),
    Case("kaleidoscope", "thu", ("fine",), "kaleidoscope", {NET: 257, PIXELS: 256, Z: 800.0}),
    Case("lux", "disk", DRAFT, "", {NET: 1025, PIXELS: 512, OUTLINE: None, TEXT: "LUX", Z: 1700.0, **square(480.0)}),
    Case("led-saddle", "led", STANDARD, "saddle", PLAIN | {NET: 129, PIXELS: 160, "target.uniform": None, Z: 800.0}),
    Case("sun-arch", "sun_caustic", DRAFT, "arch", {PIXELS: 320, Z: 320.0, "source.divergence": 0.3}),
    Case("mirror-pebbles", "mirror", STANDARD, "pebbles", {NET: 385, PIXELS: 320, Z: 750.0}),
    Case("mirror-time", "mirror", DRAFT, "", {NET: 257, PIXELS: 256, SAMPLE: None, TEXT: "8:15", Z: 1000.0}),
)  # fmt: skip

KEPT_OUT = (
    Case("lattice", "portrait", STANDARD, "lattice", {NET: 257, PIXELS: 256, Z: 850.0}),
    Case("drops", "caustic_portrait", DRAFT, "drops", {NET: 257, PIXELS: 320, Z: 300.0}),
    Case("horizon", "off_axis", STANDARD, "horizon", {NET: 385, PIXELS: 320, Z: 1050.0}),
    Case("mosaic", "thu", DRAFT, "mosaic", {NET: 513, PIXELS: 448, Z: 1250.0}),
    Case("eclipse", "disk", STANDARD, "eclipse", {NET: 385, PIXELS: 384, OUTLINE: None, Z: 850.0}),
    Case("hatching", "portrait", DRAFT, "hatching", {NET: 385, PIXELS: 448, Z: 1050.0}),
    Case("feather", "caustic_letters", STANDARD, "feather", {NET: 257, PIXELS: 320, Z: 370.0}),
    Case("bowl", "off_axis", DRAFT, "bowl", {NET: 129, PIXELS: 192, Z: 1600.0}),
    Case("knot", "thu", ("fine",), "knot", {NET: 257, PIXELS: 320, Z: 1150.0}),
    Case("ohm", "disk", DRAFT, "", {NET: 385, PIXELS: 448, OUTLINE: None, TEXT: "25 Ω", Z: 1500.0, **square(420.0)}),
    Case("led-shelf", "led", STANDARD, "shelf", PLAIN | {NET: 129, PIXELS: 144, "target.uniform": None, Z: 900.0}),
    Case("sun-leaf", "sun_caustic", DRAFT, "leaf", {PIXELS: 320, Z: 280.0, "source.divergence": 0.25}),
    Case("mirror-valley", "mirror", STANDARD, "valley", {NET: 257, PIXELS: 256, Z: 820.0}),
    Case("mirror-arrow", "mirror", DRAFT, "", {NET: 385, PIXELS: 320, SAMPLE: None, TEXT: "→ B", Z: 1100.0}),
)  # fmt: skip

CASES = {"fit": FIT, "kept out": KEPT_OUT}
