"""Scenes by which predictions are fitted, and twelve others that they are held to.

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
    Case("cat", "caustic_portrait", ALL, "chelsea", {NET: 257, PIXELS: 256, Z: 140.0}),
    Case("coffee", "portrait", BOTH, "coffee", {NET: 129, PIXELS: 256, Z: 500.0}),
    Case("rings", "disk", BOTH, "rings", {NET: 129, PIXELS: 192, OUTLINE: None, "target.uniform": None}),
    Case("rocket", "off_axis", DRAFT, "rocket", {NET: 257, PIXELS: 384}),
    Case("letters-by-point", "disk", BOTH, "", {NET: 257, PIXELS: 384, OUTLINE: None, TEXT: "Ag"}),
    Case("brick", "caustic_portrait", STANDARD, "brick", {NET: 129, PIXELS: 512}),
    Case("grass", "caustic_portrait", DRAFT, "grass", {NET: 385, PIXELS: 512, Z: 1010.0}),
    Case("checks", "thu", DRAFT, "checks", {NET: 257, PIXELS: 256, Z: 2000.0}),
    Case("spots", "disk", DRAFT, "spots", {NET: 513, PIXELS: 256, OUTLINE: None}),
    Case("slope", "thu", STANDARD, "slope", {NET: 129, PIXELS: 128, X: (-100.0, 300.0)}),
    Case("fine-net", "caustic_portrait", BOTH, "", {NET: 1025}),
    Case("fine-portrait", "portrait", STANDARD, "", {NET: 1025}),
    Case("cameraman", "caustic_portrait", STANDARD, "camera", {Z: 260.0}),
    Case("coins", "portrait", DRAFT, "coins", {NET: 257, PIXELS: 384, Z: 700.0}),
    Case("moon", "off_axis", DRAFT, "moon", {NET: 385, Z: 600.0, X: (50.0, 350.0),
                                             Y: (-150.0, 150.0)}),
    Case("words", "caustic_letters", STANDARD, "", {TEXT: "bst\ncad", Z: 420.0}),
    Case("far-word", "disk", STANDARD, "", {NET: 257, PIXELS: 256, Z: 2500.0, TEXT: "Optik", OUTLINE: None, X: (-900.0,
                                            900.0),
                                            Y: (-600.0, 600.0)}),
    Case("ramp", "disk", STANDARD, "ramp", {NET: 129, PIXELS: 128, OUTLINE: None}),
    Case("page", "caustic_letters", DRAFT, "page", {NET: 1025, "target.fit": "crop"}),
    Case("handwriting", "thu", DRAFT, "text", {X: (-200.0, 200.0)}),
    Case("clock", "portrait", STANDARD, "clock", {NET: 257, PIXELS: 256, Z: 1500.0}),
    Case("cell", "caustic_portrait", STANDARD, "cell", {NET: 129, PIXELS: 256, Z: 500.0}),
    Case("glow", "thu", DRAFT, "glow", {NET: 129, PIXELS: 256, Z: 350.0, **square(100.0)}),
    Case("retina", "off_axis", DRAFT, "retina", {NET: 1025, Z: 2000.0, X: (100.0, 900.0),
                                                 Y: (100.0, 900.0)}),
    Case("horse", "caustic_letters", STANDARD, "horse", {NET: 385, PIXELS: 384, Z: 310.0}),
    Case("tissue", "portrait", DRAFT, "immunohistochemistry", {PIXELS: 384, Z: 800.0}),
    Case("gravel", "off_axis", STANDARD, "gravel", {NET: 257, PIXELS: 256, Z: 1400.0, X: (0.0, 500.0), Y: (-250.0,
                                                    250.0)}),
    Case("galaxies", "caustic_portrait", DRAFT, "hubble_deep_field", {NET: 257, Z: 180.0}),
    Case("vessels", "thu", STANDARD, "microaneurysms", {NET: 257, PIXELS: 128, Z: 700.0}),
    Case("number", "disk", DRAFT, "", {NET: 385, PIXELS: 384, OUTLINE: None, TEXT: "2048", Z: 900.0}),
    Case("initial", "caustic_portrait", STANDARD, "", {NET: 257, PIXELS: 256, SAMPLE: None, TEXT: "R", Z: 700.0}),
    Case("phantom", "disk", STANDARD, "shepp_logan_phantom", {NET: 129, PIXELS: 192, OUTLINE: None}),
    Case("wedge", "caustic_letters", DRAFT, "wedge", {NET: 129, PIXELS: 192, Z: 600.0}),
    Case("vignette", "portrait", ("standard", "fine"), "vignette", {NET: 129, PIXELS: 192, Z: 400.0}),
    Case("sentence", "caustic_letters", DRAFT, "", {NET: 1025, TEXT: "light\nfollows\nform", Z: 150.0}),
    Case("wheel", "thu", DRAFT, "colorwheel", {NET: 1025, Z: 1600.0}),
    Case("spiral", "disk", STANDARD, "spiral", {NET: 257, PIXELS: 256, OUTLINE: None, Z: 600.0}),
    Case("zone-plate", "thu", DRAFT, "zone plate", {NET: 385, PIXELS: 384, Z: 1300.0}),
    Case("star", "caustic_letters", STANDARD, "star", {NET: 129, PIXELS: 256, Z: 220.0}),
    Case("clouds", "off_axis", DRAFT, "clouds", {NET: 1025, Z: 1200.0, X: (-50.0, 450.0),
                                                 Y: (-250.0, 250.0)}),
    Case("dusk", "portrait", STANDARD, "dusk", {NET: 129, PIXELS: 128, Z: 350.0}),
    Case("faces", "caustic_portrait", STANDARD, "faces", {NET: 385, PIXELS: 384, Z: 450.0}),
    Case("chess", "off_axis", STANDARD, "checkerboard", {NET: 257, PIXELS: 192, Z: 900.0}),
    Case("logo", "portrait", DRAFT, "logo", {NET: 257, PIXELS: 320, Z: 900.0}),
    Case("islands", "caustic_letters", DRAFT, "islands", {NET: 257, PIXELS: 256, Z: 900.0}),
    Case("sign", "disk", DRAFT, "", {PIXELS: 512, OUTLINE: None, TEXT: "EXIT", Z: 1800.0, **square(500.0)}),
    Case("year", "thu", STANDARD, "", {NET: 257, PIXELS: 256, TEXT: "1905", Z: 3000.0}),
    Case("poem", "caustic_portrait", DRAFT, "", {NET: 1025, SAMPLE: None, Z: 350.0, TEXT: "more\nlight\non paper"}),
    Case("motorcycle", "off_axis", STANDARD, "motorcycle", {PIXELS: 448, Z: 1300.0, X: (0.0, 450.0),
                                                            Y: (-150.0, 150.0)}),
    Case("bust", "portrait", STANDARD, "bust", {NET: 257, PIXELS: 320, Z: 650.0}),
    Case("emblem", "thu", STANDARD, "emblem", {NET: 129, PIXELS: 192, Z: 2400.0}),
    Case("contours", "caustic_portrait", ("fine",), "contours", {NET: 385, PIXELS: 256, Z: 380.0}),
    Case("sheen", "portrait", STANDARD, "sheen", {NET: 129, PIXELS: 128, Z: 800.0}),
    Case("studio", "disk", STANDARD, "", {NET: 257, PIXELS: 320, OUTLINE: None, Z: 2200.0,
                                          TEXT: "ON\nAIR", **square(600.0)}),
    Case("relief", "disk", DRAFT, "relief", {NET: 513, PIXELS: 384, OUTLINE: None, Z: 700.0}),
    Case("matrix-code", "caustic_letters", DRAFT, "matrix code", {NET: 1025, Z: 280.0}),
    Case("bar-code", "portrait", DRAFT, "bar code", {NET: 385, PIXELS: 320, Z: 1200.0}),
    Case("boat", "caustic_letters", DRAFT, "line drawing", {PIXELS: 384, Z: 520.0}),
    Case("keys", "off_axis", STANDARD, "keys", {NET: 1025, PIXELS: 384, Z: 1500.0, X: (-100.0, 500.0),
                                                Y: (-300.0, 300.0)}),
    Case("greeting", "caustic_portrait", DRAFT, "", {NET: 257, PIXELS: 320, SAMPLE: None, Z: 200.0,
                                                     TEXT: "Grüße\naus\nUlm"}),
    Case("petals", "portrait", STANDARD, "petals", {NET: 257, PIXELS: 256, Z: 900.0}),
    Case("stripes", "caustic_portrait", STANDARD, "stripes", {NET: 385, PIXELS: 320, Z: 330.0}),
    Case("blobs", "disk", DRAFT, "blobs", {NET: 257, PIXELS: 256, OUTLINE: None, Z: 900.0}),
    Case("corner", "thu", STANDARD, "corner", {NET: 257, PIXELS: 256, Z: 1700.0}),
    Case("frame", "portrait", BOTH, "frame", {PIXELS: 384, Z: 750.0}),
    Case("swirl", "off_axis", DRAFT, "swirl", {NET: 385, PIXELS: 320, Z: 1250.0}),
    Case("question", "thu", DRAFT, "", {NET: 385, PIXELS: 448, TEXT: "Q7&", Z: 1200.0}),
    Case("zebra", "caustic_letters", STANDARD, "", {NET: 129, PIXELS: 256, TEXT: "zebra", Z: 250.0}),
    Case("no-five", "disk", STANDARD, "", {NET: 385, PIXELS: 448, OUTLINE: None,
                                           TEXT: "No 5", Z: 1600.0, **square(450.0)}),
    Case("far-portrait", "portrait", DRAFT, "", {NET: 1025, Z: 1150.0}),
    Case("petals-by-net", "caustic_portrait", DRAFT, "petals", {NET: 1025, PIXELS: 384, Z: 260.0}),
    Case("blobs-aside", "off_axis", STANDARD, "blobs", {NET: 257, PIXELS: 384, Z: 1100.0}),
    Case("polygons", "portrait", DRAFT, "polygons", {NET: 385, PIXELS: 384, Z: 800.0}),
    Case("many-polygons", "disk", STANDARD, "many polygons", {NET: 257, PIXELS: 320, OUTLINE: None, Z: 1100.0}),
    Case("few-polygons", "off_axis", DRAFT, "few polygons", {PIXELS: 448, Z: 1000.0}),
    Case("discs", "portrait", DRAFT, "discs", {NET: 1025, PIXELS: 448, Z: 1000.0}),
    Case("many-discs", "disk", DRAFT, "many discs", {NET: 1025, OUTLINE: None, PIXELS: 512, Z: 1500.0}),
    Case("marble", "thu", STANDARD, "marble", {NET: 385, PIXELS: 320, Z: 900.0}),
    Case("hills", "portrait", BOTH, "hills", {NET: 257, PIXELS: 256, Z: 1300.0}),
    Case("felt", "caustic_portrait", STANDARD, "felt", {NET: 385, PIXELS: 384, Z: 400.0}),
    Case("strokes", "off_axis", DRAFT, "strokes", {NET: 257, PIXELS: 256, Z: 1500.0}),
    Case("many-strokes", "disk", BOTH, "many strokes", {NET: 513, PIXELS: 512, OUTLINE: None, Z: 900.0}),
    Case("fine-dots", "caustic_letters", STANDARD, "fine dots", {NET: 385, PIXELS: 384, Z: 300.0}),
    Case("dots", "portrait", DRAFT, "dots", {NET: 257, PIXELS: 320, Z: 600.0}),
    Case("cross", "thu", BOTH, "cross", {PIXELS: 384, Z: 1000.0}),
    Case("bullseye", "portrait", DRAFT, "bullseye", {NET: 1025, PIXELS: 512, Z: 900.0}),
    Case("fringes", "off_axis", STANDARD, "fringes", {NET: 257, PIXELS: 256, Z: 800.0}),
    Case("folds", "disk", BOTH, "folds", {NET: 385, PIXELS: 384, OUTLINE: None, Z: 1300.0}),
    Case("steps", "caustic_portrait", DRAFT, "steps", {PIXELS: 448, Z: 220.0}),
    Case("window", "portrait", STANDARD, "window", {NET: 385, PIXELS: 320, Z: 1100.0}),
    Case("name", "disk", STANDARD, "", {NET: 513, PIXELS: 448, OUTLINE: None, TEXT: "bst", Z: 1200.0}),
    Case("hello", "portrait", DRAFT, "", {NET: 385, PIXELS: 384, SAMPLE: None, TEXT: "Hi!", Z: 900.0}),
    Case("answer", "off_axis", DRAFT, "", {NET: 1025, PIXELS: 512, SAMPLE: None, TEXT: "42"}),
    Case("unit", "thu", DRAFT, "", {NET: 1025, PIXELS: 512, TEXT: "mm", Z: 1500.0}),
    Case("clock-aside", "off_axis", STANDARD, "clock", {NET: 1025, Z: 1300.0}),
    Case("astronaut", "portrait", STANDARD, "astronaut", {Z: 900.0}),
    Case("camera-near", "disk", DRAFT, "camera", {NET: 1025, PIXELS: 384, OUTLINE: None, Z: 1000.0}),
    Case("cat-far", "thu", DRAFT, "chelsea", {PIXELS: 384, Z: 1400.0}),
)  # fmt: skip

KEPT_OUT = (
    Case("hopper", "portrait", STANDARD, "hopper", {Z: 1200.0}),
    Case("terrain", "caustic_portrait", DRAFT, "terrain", {NET: 385, PIXELS: 384, Z: 360.0}),
    Case("head", "off_axis", DRAFT, "head", {NET: 257, PIXELS: 256, Z: 1150.0}),
    Case("coast", "thu", STANDARD, "coast", {NET: 1025, PIXELS: 320, Z: 1100.0}),
    Case("cells", "portrait", DRAFT, "cells", {NET: 385, PIXELS: 320, Z: 1050.0}),
    Case("cog", "disk", STANDARD, "cog", {NET: 257, PIXELS: 256, OUTLINE: None, Z: 750.0}),
    Case("maze", "caustic_letters", DRAFT, "maze", {PIXELS: 448, Z: 270.0}),
    Case("sunset", "off_axis", STANDARD, "sunset", {NET: 257, PIXELS: 320, Z: 1700.0}),
    Case("julia", "thu", DRAFT, "julia", {NET: 1025, PIXELS: 512, Z: 1050.0}),
    Case("hearts", "caustic_portrait", ("fine",), "hearts", {NET: 257, PIXELS: 320, Z: 290.0}),
    Case("distress", "portrait", STANDARD, "", {NET: 129, PIXELS: 256, SAMPLE: None, TEXT: "SOS", Z: 1000.0}),
    Case("quarter-wave", "disk", DRAFT, "", {NET: 257, PIXELS: 384, OUTLINE: None,
                                             TEXT: "λ/4", Z: 1400.0, **square(350.0)}),
)  # fmt: skip

CASES = {"fit": FIT, "kept out": KEPT_OUT}
