"""Every two values of every two choices of a scene in at least one lens; every light, rim and front by `make bench`.

The daily suite designs few lenses that hold each value once.

Each scene is designed with few control points and pixels, written, proved from its files and opened again; flux tubes
repeat what its rays found.  Each value is previewed in a scene at least and planned in one; these scenes alone have
a data sheet, estimates of effects that are left out, and a comparison of precisions, too.  A scene may end in a report,
whose failed checks are true (MAY_FAIL), or in a refusal that names the keys that do not go together (REFUSED).  A new
value of a choice is one line of CHOICES.

The array is made here: the packages for such arrays know one strength for all choices, and triples of some are wanted.
"""

from __future__ import annotations

import gc
import itertools
import math
import random
import re
from collections import defaultdict
from dataclasses import replace
from functools import partial

import numba
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_closing, binary_dilation

import bstcad
from bstcad import commands
from bstcad.api import Design
from bstcad.commands import ProofOptions
from bstcad.designs import pipeline
from bstcad.figures.figure_jobs import NoPictures
from bstcad.manufacture.shop import as_built
from bstcad.manufacture.shop.as_built import AsBuilt
from bstcad.optics.surfaces.charts import HEIGHTS
from bstcad.optics.surfaces.outlines import Circle, Rectangle
from bstcad.optics.surfaces.sides import as_pair
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace.measure import Effort, measure_goals, rrmsd_by_tubes, side_factor
from bstcad.optics.trace.reach import grazing_of, spread_at
from bstcad.optics.trace.trace import across
from bstcad.optics.trace.tubes import rays_to
from bstcad.photometry import tm25
from bstcad.photometry.intensity import Luminaire
from bstcad.photometry.ray_set import RaySet
from bstcad.planning.plan import plan
from bstcad.planning.prediction import run_pilot
from bstcad.planning.preview import preview
from bstcad.planning.reduction import Reduction
from bstcad.scene.errors import SceneError
from bstcad.scene.fronts import as_front, net_extent
from bstcad.scene.lamp import IntensityFile, RayFile
from bstcad.tailoring.stage2 import PrecisionComparison
from tests import suite
from tests.conftest import verify_with
from tests.efforts import LITTLE, designed_quickly
from tests.planning.conftest import typical_pilot

# --- the choices ------------------------------------------------------------------------------------------------------

SIZES = {"square": (16.0, 16.0), "wide": (24.0, 12.0), "tall": (12.0, 24.0), "circle": (16.0, 16.0)}  # mm
THROW, BEFORE = 80.0, 60.0  # mm: from the back to the wall, from the lamp to the lens
BACK = 6.0  # mm, z of the back; the front is at 0
DOME = {"kind": "radial", "centre": [0.0, 0.0, BACK - 12.0], "radius": 15.0, "half_angle": 40.0, "control_points": 21}


def rim(chosen, less=0.0):
    """The rim of the lens, or one so many mm smaller."""
    width, height = (side - less for side in SIZES[chosen["rim"]])
    if chosen["rim"] == "circle":
        return {"shape": "circle", "diameter": width}
    return {"shape": "rectangle", "width": width, "height": height}


def outline(chosen):
    """The rim as the lens has it; a dome has its own circle."""
    return {"lens.outline": None if chosen["back"] == "dome" and chosen["rim"] == "circle" else rim(chosen)}


def beam(**more):
    """Parallel light over the lens; before a mirror it starts above."""

    def source(chosen):
        start = {"z": BEFORE} if "mirror" in chosen["front"] else {}
        return {"source": {"kind": "collimated", "aperture": rim(chosen), **start, **more}}

    return source


def measured(chosen):
    """The picture of a beam of two colours, brighter to a side, that is wider than every rim."""
    x, y = np.meshgrid(np.linspace(-15, 15, 64), np.linspace(15, -15, 64))
    light = np.exp(-2 * (x**2 + y**2) / 11.0**2) * (1 + 0.02 * x)
    profile = {"image": light, "width": 30.0, "origin": "picture"}
    return beam(wavelength=[[486.1, 1.0], [656.3, 1.0]])(chosen) | {"source.profile": profile}


def lamp(**more):
    """A lamp before the lens, in the middle of a dome, or above a mirror."""

    def source(chosen):
        position = [0.0, 0.0, BEFORE if "mirror" in chosen["front"] else -BEFORE]
        position = DOME["centre"] if chosen["back"] == "dome" else position
        return {"source": {"kind": "point", "profile": "lambertian", "position": position, **more}}

    return source


def wall(x, y, tilt=(0.0, 0.0), **more):
    return {"target.x": x, "target.y": y, "target.tilt": list(tilt), **more}


POINT = {"accept.point": [{"at": [5.0, -2.0], "least": 0.0, "most": 1e9}]}


def directions(chosen):
    """Radiant intensity over the angles that the square wall has, with a test point and a cut-off."""
    part_middle = 10.0 if chosen["back"] == "dome" else 22.0  # the line of the cut-off is lit
    ends, middle = [-14.0, 14.0], part_middle if chosen["reach"] == "part" else 0.0
    return {"target.kind": "intensity", "target.z": None, "target.x": ends, "target.y": ends} | {
        "accept.point": [{"at": [1.0, -2.0], "least": 0.0, "most": 1e9, "radius": 3.0}],
        "accept.cut_off": {"at": middle + 2.0, "most": 100.0, "step": 4.0},
    }


def part(chosen):
    """A wall, or angles, that go on beyond the 48 degrees by which glass turns light at most."""
    far = 20.0 if chosen["back"] == "dome" else 62.0  # degrees; a dome would cross its front
    if chosen["picture"] == "profile":
        far = min(far, 50.0)  # the disc in the middle of the wall is within reach
    ends = [-18.0, far if chosen["wall"] == "directions" else 90.0 * math.tan(math.radians(far))]
    fine = {"target.pixels": 32} if chosen["picture"] == "profile" else {}  # a second wall has a pixel on the disc
    return {"target.x": ends, **fine}


def photo(chosen):
    x, y = np.meshgrid(np.linspace(0, 3, 48), np.linspace(0, 3, 40))
    return {"target.image": 0.3 + np.sin(x) ** 2 * np.cos(y - 1) ** 2}


def spline_file(chosen):
    """The net of a bowl."""
    outline = Circle(8.0) if chosen["rim"] == "circle" else Rectangle(*SIZES[chosen["rim"]])
    half_x, half_y = net_extent(outline, 17)
    bowl = bstcad.BSplineSurface.fitted(Sphere(0.0, -0.005), (-half_x, half_x), (-half_y, half_y), 17)
    return {"lens.front": as_front(bowl)}


def pair(chosen):
    """About a control point a millimetre, more along the longer side."""
    width, height = SIZES[chosen["rim"]]
    return {"lens.back.control_points": [round(1.3 * width), round(1.3 * height) + 2]}


def flange(chosen):
    """A plate around the lens between its faces."""
    return {"mount": {"flange": {"outline": rim(chosen, -6.0), "z": 0.6, "thickness": 0.5}}}


def cut(chosen):
    return {"mount": {"rim": rim(chosen, 1.0), "draft": 1.0, "bevel": 0.1, "datum": "front"}}


def two(chosen):
    """A second wall, twice as far away, where light goes on that fills the lens and the first one."""
    own = changes_of(chosen, "targets")
    if chosen["wall"] == "directions":
        shown = {key.removeprefix("target."): own[key] for key in own if key.startswith("target.")}
        far = {key: value for key, value in {**SMALL["target"], **shown}.items() if key != "z"}
        return {"target": [far, {key: value for key, value in far.items() if key != "kind"} | {"z": BACK + THROW}]}
    near = SMALL["target"] | {key.removeprefix("target."): own[key] for key in own if key.startswith("target.")}
    further = -THROW if chosen["elements"] == "fold mirror behind" else THROW
    halves = zip("xy", (side / 2 for side in SIZES[chosen["rim"]]), strict=True)
    ends = {axis: [2 * near[axis][0] + half, 2 * near[axis][1] - half] for axis, half in halves}
    return {"target": [near, near | ends | {"z": near["z"] + further}]}


def elements(where, **more):
    """A window or a mirror; before a lens the light comes from below, before a mirror from above."""

    def element(chosen):
        z = 30.0 if where == "behind" else 20.0 if "mirror" in chosen["front"] else -20.0
        return {where: [{"kind": "window", "z": z, "outline": {"shape": "circle", "diameter": 60.0}} | more]}

    return element


def fold(chosen):
    """A mirror half way to the wall, which is as far from the lens as without it."""
    mirror = elements("behind", kind="mirror", z=BACK + 50.0, outline={"shape": "circle", "diameter": 200.0})
    return mirror(chosen) | ({} if chosen["wall"] == "directions" else {"target.z": BACK + 2 * 50.0 - THROW})


def ray_file(count=40_000):
    """Rays of a chip of 1 x 0.5 mm in two colours, brighter towards +x, that start on their way to the lens."""
    chance = np.random.default_rng(7)
    slope = [0.05, 0.0] + [0.35, 0.3] * chance.standard_normal((count, 2))
    direction = np.hstack([slope, np.ones((count, 1))])
    start = np.hstack([(chance.random((count, 2)) - 0.5) * [1.0, 0.5], np.zeros((count, 1))]) + 2.0 * direction
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    colour = np.where(chance.random(count) < 0.4, 486.1, 656.3)
    position, direction, power, colour = (
        np.asarray(part, np.float32) for part in (start, direction, np.full(count, 1e-4), colour)
    )
    rays = RaySet(position, direction, power, "W", wavelength=colour)
    return RayFile("rays-chip.tm25ray", tm25.write(rays, Luminaire("chip")))


def front(**more):
    return {"lens.front": {"z": 0.0, **more}}


def conic(chosen):
    """A flat paraboloid, or for a dome an ellipsoid around the lamp."""
    hollow = {"curvature": 1 / DOME["centre"][2], "conic_constant": -0.3}
    return front(kind="conic", **(hollow if chosen["back"] == "dome" else {"curvature": 0.005, "conic_constant": -1.0}))


CHOICES = {
    "light": {
        "laser": beam(),
        "tilted Gaussian beam": beam(profile="gaussian", radius_1e2=[9.0, 7.0], rotate=20.0, tilt=[2.0, -3.0]),
        "measured beam": measured,
        "sun": beam(divergence=[0.53, 0.2], rotate=30.0),
        "cone": lamp(profile="uniform", half_angle=12.0, lumens=100.0),
        "intensity file": lamp(
            intensity=IntensityFile("lamp.csv", b"g,0,90,180,270\n0,9,9,9,9\n20,8,7,6,7\n60,0,0,0,0\n")
        ),
        "ray file": lamp(rays=ray_file()),
        "round LED": lamp(diameter=1.0),
        "chip": lamp(width=1.0, height=0.5),
    },
    "rim": dict.fromkeys(SIZES, outline),
    "wall": {
        "square": wall([-18.0, 18.0], [-18.0, 18.0]),
        "wide": wall([-24.0, 24.0], [-12.0, 12.0]),
        "tall": wall([-12.0, 12.0], [-24.0, 24.0]),
        "off axis": wall([4.0, 36.0], [-14.0, 18.0], **POINT),
        "tilted": wall([-18.0, 18.0], [-18.0, 18.0], tilt=(12.0, -18.0)),
        "directions": directions,
    },
    "picture": {
        "letters": {"target.text": "HI"},
        "photo": photo,
        "part of a photo": lambda chosen: photo(chosen) | {"target.crop": [0.1, 0.0, 0.9, 0.7]},
        "even": {"target.uniform": True},
        "profile": {"target.profile": {"shape": "disc", "radius": 12.0}},
    },
    "back": {"heights": {}, "dome": {"lens.back": DOME}},
    "front": {
        "plane": front(kind="plane"),
        "free sphere": front(kind="sphere", optimise=True),
        "conic": conic,
        "toroid": front(kind="toroid", curvature_x=0.005, curvature_y=-0.003),
        "spline file": spline_file,
        "tailored spline": front(kind="bspline", optimise=True),
        "mirror": front(kind="plane") | {"lens.back.reflect": True, "lens.material": None},
        "mirror behind glass": front(kind="bspline", optimise=True, reflect=True),
    },
    "medium": {"air": {}, "encapsulant": {"lens.encapsulant": 1.55}},
    "net": {"one number": {}, "pair": pair, "chosen": {"lens.back.control_points": None}},
    "effects": {
        "none": {},
        "reflection": {"effects": [{"kind": "fresnel"}]},
        "coating": {"effects": [{"kind": "fresnel", "coating": {"index": 1.38, "thickness": 100.0}}]},
        "absorption": {"effects": [{"kind": "absorption"}]},
        "ghost": {"effects": [{"kind": "ghost"}]},
    },
    "bounds": {
        "none": {},
        "tool": {"lens.tool_radius": 5.0},
        "mould": {"lens.tool_radius": 5.0, "lens.mould": True},
        "slope": {"lens.max_slope": 40.0},
        "thickness": {"lens.max_thickness": 12.0, "lens.edge_thickness": 1.0},
    },
    "mount": {"none": {}, "flange": flange, "cut": cut},
    "moulding": {
        "none": {},
        "one shrinkage": {"moulding": {"shrinkage": 0.005}, "output.export": ["cavity"]},
        "along each axis": {
            "moulding": {"shrinkage": [0.005, 0.006, 0.004], "relative_to": "part"},
            "output.export": ["cavity"],
        },
    },
    "elements": {
        "none": {},
        "dome before": elements("before", thickness=3.0, index=1.5, curvature=[0.004, 0.005], tilt=[3.0, 0.0]),
        "window behind": elements("behind", thickness=3.0, material="N-BK7", tilt=[0.0, 5.0]),
        "fold mirror behind": fold,
    },
    "wavefront": {
        "none": {},
        "plane": {"wavefront": {"kind": "plane", "z": 45.0}},
        "sphere": {"wavefront": {"kind": "sphere", "z": 45.0, "focus": [0.0, 0.0, -60.0]}},
    },
    "precision": {"float64": {}, "float32": {"tailoring.precision": "float32"}},
    "accuracy": {"none": {}, "asked": {"tailoring.accuracy": 0.3}, "half pixels": {"accept.rrmsd_half": 3.0}},
    "time": {"none": {}, "limited": {"tailoring.max_time": 100.0}},
    "reach": {"whole": {}, "part": part},
    "export": {"none": {}, "tiles from below": {"output.export": ["raster", "tiles"], "output.zero": "bottom"}},
    "targets": {"one": {}, "two": two},
    "grade": {
        "none": {},
        "milled": {"tolerance": [{"grade": "milled-sanded", "roughness": 300.0}]},
        "printed": {"tolerance": [{"grade": "resin-printed", "layer_height": 0.1}]},
        "coated": {"tolerance": [{"grade": "resin-printed-coated"}, {"name": "back.form", "limit": 1e-3}]},
    },
}
PLAIN = {choice: next(iter(values)) for choice, values in CHOICES.items()}
SMALL = {
    "name": "combination", "accept": {}, "target": {"z": BACK + THROW, "pixels": 24},
    "lens": {"material": "PMMA", "min_thickness": 1.5, "back": {"kind": "bspline", "z": BACK, "control_points": 21}},
    "tailoring": {
        "quality": "draft", "rays": 40, "transport_grid": 24, "transport_iterations": 6, "stage2_iterations": 2,
        "rounds": 2, "source_points": 2,
    },
}  # fmt: skip
WITHOUT_DOME = {  # values that do not go with a dome
    "light": ("laser", "tilted Gaussian beam", "measured beam", "sun"),
    "rim": ("square", "wide", "tall"),
    "front": ("free sphere", "toroid", "spline file", "tailored spline", "mirror", "mirror behind glass"),
    "net": ("pair",),
    "bounds": ("tool", "mould", "slope", "thickness"),
    "mount": ("cut",),
    "elements": ("dome before", "window behind", "fold mirror behind"),
    "wavefront": ("plane", "sphere"),
    "export": ("tiles from below",),
}
REFUSED = (  # the least sets of values that no scene has together
    *(
        {("light", light), ("wavefront", wave)}
        for light in ("sun", "ray file", "round LED", "chip")
        for wave in ("plane", "sphere")
    ),
    *(
        {("light", light), ("medium", "encapsulant")}
        for light in ("laser", "tilted Gaussian beam", "measured beam", "sun")
    ),
    *({("front", front), ("medium", "encapsulant")} for front in ("mirror", "mirror behind glass")),
    {("elements", "dome before"), ("medium", "encapsulant")},
    *({("wavefront", wave), ("medium", "encapsulant")} for wave in ("plane", "sphere")),
    {("rim", "circle"), ("net", "pair")},
    *({("wall", "directions"), ("elements", each)} for each in ("window behind", "fold mirror behind")),
    *({("wall", "directions"), ("wavefront", wave)} for wave in ("plane", "sphere")),
    {("wall", "directions"), ("targets", "two")},
    *({("elements", "fold mirror behind"), ("wavefront", wave)} for wave in ("plane", "sphere")),
    *({("front", "mirror"), ("effects", effect)} for effect in ("coating", "absorption", "ghost")),
    {("front", "mirror behind glass"), ("effects", "ghost")},
    *({("back", "dome"), (choice, value)} for choice, values in WITHOUT_DOME.items() for value in values),
)
NAMED = {  # the key of a choice, as the sentence of a refusal has it
    "light": "source.", "wavefront": "wavefront", "rim": "lens.outline", "net": "lens.back.control_points",
    "front": ".reflect", "effects": "effects[0]", "elements": "behind", "wall": "target", "targets": "target",
    "export": "output.export", "back": "back", "bounds": "lens.", "mount": "mount", "medium": "lens.encapsulant",
}  # fmt: skip


def changes_of(chosen, *but):
    """The keys of a scene; but: choices that are left out."""
    found = {}
    for choice in (choice for choice in CHOICES if choice not in but):
        value = CHOICES[choice][chosen[choice]]
        found |= value(chosen) if callable(value) else value
    return found


def scene_of(chosen):
    changes = SMALL | changes_of(chosen)
    if isinstance(changes["target"], list):
        changes = {key: value for key, value in changes.items() if not key.startswith("target.")}
    return bstcad.load("templates/disk.toml").changed(changes)


# --- the array --------------------------------------------------------------------------------------------------------


def possible(values):
    """Can a scene have these (choice, value) together?"""
    return not any(together <= values for together in REFUSED)


def to_cover(strength, choices=tuple(CHOICES)):
    """All sets of so many (choice, value) that a scene can have."""
    for some in itertools.combinations(choices, strength):
        for values in itertools.product(*(CHOICES[choice] for choice in some)):
            if possible(found := frozenset(zip(some, values, strict=True))):
                yield found


def covering(wanted, tries=8):
    """Scenes in which each wanted set occurs, the best of some tries at a time (AETG, Cohen et al. 1997)."""
    left, chance, scenes = list(wanted), random.Random(1), []
    while left:
        holding = defaultdict(list)  # the sets that are left, by each of their values
        for each in left:
            for value in each:
                holding[value].append(each)
        found = [scene_with(left[0], holding, chance) for _ in range(tries)]
        best = max(found, key=lambda scene: sum(each <= scene for each in left))
        left = [each for each in left if not each <= best]
        scenes.append({choice: dict(best)[choice] for choice in CHOICES})
    return scenes


def scene_with(first, holding, chance):
    """A scene that holds a set: its other choices in any order, each by the value that meets most of what is left.

    Where none meets anything, by the first, the plainest: it takes less time, and a fault is seen alone.
    """
    scene, others = set(first), [choice for choice in CHOICES if choice not in dict(first)]
    for choice in chance.sample(others, len(others)):
        values = [(choice, value) for value in CHOICES[choice] if possible(scene | {(choice, value)})]
        met = [sum(each <= scene | {value} for each in holding[value]) for value in values]
        best = [value for value, count in zip(values, met, strict=True) if count == max(met)]
        scene.add(chance.choice(best) if max(met) else best[0])
    return scene


def holding_each_value(scenes, first=0):
    """Return the numbers of few scenes that together hold each value that occurs (greedy cover, from the `first`)."""
    missing, found = {value for scene in scenes for value in scene.items()}, []
    order = [*range(first, len(scenes)), *range(first)]
    while missing:
        found.append(max(order, key=lambda k: len(missing & scenes[k].items())))
        missing -= scenes[found[-1]].items()
    return found


PAIRS = covering(to_cover(2))
PREVIEWED = holding_each_value(PAIRS)  # numbers of the scenes that are previewed
PLANNED = holding_each_value(PAIRS, len(PAIRS) // 3)  # numbers of the scenes that are planned
RETAILORED = holding_each_value(PAIRS, 2 * len(PAIRS) // 3)  # numbers of the scenes with a blank as built
ONCE = covering(to_cover(1))  # scenes of the daily suite, which hold each value once
TRIPLES = "light", "rim", "front"


# --- a scene from its plan to its files and back ----------------------------------------------------------------------

EFFORT = Effort(64, places=33, points=64, tubes=48, source_points=(2, 4))
MORE_RAYS = replace(EFFORT, rays=256)  # effort that tells the noise of few rays from a fault
POINTS, TUBES = 16, 192  # points of a source, and flux tubes per side, for the RRMSD that the proof is compared with
MAX_DIFFERENCE, MAX_RELATIVE_DIFFERENCE = 0.02, 0.1  # largest difference of these RRMSDs, besides the noise of rays
HASTY = Reduction(pixels=16, net=17, cells=16, tubes=32, rounds=1, evaluations=1, blurred=1)
MAY_FAIL = (  # checks by the beginning of their names, the choices under which they may fail, and why that is true
    ("wavefront", {}, "one net has no two goals"),
    (
        r"test point",
        {"wall": "off axis", "reach": "part", "picture": "letters"},
        "few steps light no letter at 41 degrees",
    ),
    (r"part\.step", {"mount": "flange"}, "a back that is steep is cut by the plane of the flange"),
    (r"part\.step", {"mount": "cut", "front": "free sphere", "reach": "part"}, "no wall is left between steep faces"),
)
MAY_REFUSE = (  # sentences of designs, and the choices that cannot be had together there
    (r"lens.front.optimise: with the front that the target needs, mount\.", {"front": "free sphere"}),
    (r"target: .* of the light would have to leave the back outside of lens.outline", {"front": "tailored spline"}),
    (r"lens.back.half_angle: .* of the light.* cannot reach a lit part", {"back": "dome", "medium": "encapsulant"}),
    (
        r"lens.back.half_angle: .* of the light.* cannot reach a lit part",  # 5.1 % of it; 5 % are allowed
        {"back": "dome", "wall": "off axis", "light": "chip"},
    ),
    (
        r"lens.back.half_angle: .* of the light.* cannot reach a lit part",  # a disc of 24 mm, 40 mm away, is narrow
        {"back": "dome", "wall": "tilted", "picture": "profile", "front": "conic"},
    ),
)
PILOT = Reduction(pixels=24, net=17, cells=16, tubes=48, fewest_points=65, effort=LITTLE)
PILOT_RAYS = Effort(96, accuracy=1.0, witness=False, source_points=(2, 4))


class Words(NoPictures):
    """The words of the data sheet, and no pictures."""

    def sheet(self, draw, sheet):
        assert all(sheet.tables.values())


NO_DIFFERENCE = PrecisionComparison(
    21, merit=0.0, gradient=0.0, evaluations=2, rrmsd_float64=0.1, rrmsd_float32=0.1, heights=0.0
)  # comparison of precisions of a scene that is neither previewed nor planned
FLOWN = 4  # number of planned scenes of which the last has a real pilot; each has the small scene that a pilot designs


def pilots():
    """Yield functions that give the pilot of a scene: a real one is one more design, of the same choices."""
    real = partial(run_pilot, size=PILOT, rays=PILOT_RAYS)
    return itertools.cycle([*(FLOWN - 1) * [typical_pilot], real])


PILOTS = pilots()


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Few rays and tubes, and no figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bstcad.commands.Pictures", Words)
        verify_with(patch, EFFORT)
        threads = torch.get_num_threads(), numba.get_num_threads()
        torch.set_num_threads(1)  # on so few points more threads cost more than they save
        numba.set_num_threads(1)
        gc.freeze()
        gc.disable()  # a fifteenth of the time; each scene is collected at its end
        yield
        gc.enable()
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])


def faults(chosen, folder, *, previewed=True, planned=True, retailored=True):
    """The faults of a scene from its plan to its files and back, as sentences."""
    with pytest.MonkeyPatch.context() as patch:
        if not (previewed or planned):
            patch.setattr("bstcad.commands.Pictures", NoPictures)
            patch.setattr("bstcad.commands.left_out", lambda *given: ())
            patch.setattr("bstcad.designs.pipeline.compare_precisions", lambda *given: NO_DIFFERENCE)
        return _faults(chosen, folder, previewed=previewed, planned=planned, retailored=retailored)


def _faults(chosen, folder, *, previewed, planned, retailored):
    scene = scene_of(chosen)
    try:
        seen = preview(scene, HASTY) if previewed else None
        report = commands.generate(scene, folder, device="cpu", options=ProofOptions(EFFORT, tailoring=LITTLE))
        again = bstcad.open(folder)  # its scene states the net, if that was to be chosen
        told, predicted = plan(again.scene, pilot=next(PILOTS)) if planned else ({}, {})
    except SceneError as refusal:
        return [] if any(_holds(*each, str(refusal), chosen) for each in MAY_REFUSE) else [f"refused: {refusal}"]
    assert not previewed or all(np.isfinite(picture).all() for pictures in seen.pictures for picture in pictures)
    assert not planned or ({"simulated", "left_out", "blur"} <= set(told) and "predicted" in predicted)
    assert again.report.rrmsd == pytest.approx(report.rrmsd, rel=1e-3)
    assert again.lens.back.shape == as_pair(again.scene.lens.back.net)
    if chosen["grade"] != "none":
        made = again.as_made()
        assert all(np.isfinite(goal.made).all() and 0 < goal.light <= 1 + 1e-9 for goal in made.goals)
        assert made.finish.is_marked and all(len(goal.changes) == 3 for goal in made.goals)
    if chosen["export"] == "tiles from below":
        comments = (folder / "toolpath-raster-tile-1-1.nc").read_text("ascii").replace(")\n(", " ")
        assert "Z0 on the bottom of the blank" in comments
    if found := _failed(report, chosen):
        found = _failed(again.verify(effort=MORE_RAYS, progress=False), chosen)
    found += [*_ripples(report), *_differences(report, again)]
    return found + (list(_as_built(again)) if retailored else [])


def _ripples(report):
    """Yield targets whose light on half pixels is much worse than on pixels."""
    for figures in report.goals:
        half, noise = figures.on_cells(0.5), 3 * figures.rrmsd_standard_error
        if half is None:
            yield f"{figures.key}: not measured on half pixels"
        elif half.rrmsd > MAX_HALF_RATIO_OF_ALL * (figures.rrmsd + noise) + MAX_HALF_OF_ALL + 3 * half.standard_error:
            yield f"{figures.key}: RRMSD {figures.rrmsd:.3f} on pixels, {half.rrmsd:.3f} on half pixels"


def _as_built(design):
    """Yield a fault if the back cannot be tailored to a thickness and an index of the blank, or is then worse."""
    made = design._made
    thickness = made.lens.back_net.vertex_z - made.lens.front.z + 0.02
    index = made.scene.index + 2e-3 if made.scene.lens.passes.enters else None
    found = as_built.retailor(made, AsBuilt(thickness=thickness, index=index), effort=LITTLE)
    again, effort = found.made, LITTLE.between_stages(made.goals, as_built.RAYS)
    after = max(light.rrmsd for light in again.lights(again.lens, again.goals, effort))
    if not after < 1.1 * max(found.design, found.before) + MAX_DIFFERENCE:
        yield f"as built: RRMSD {found.design:.3f} designed, {found.before:.3f} before, {after:.3f} after"


def _differences(report, design):
    """Yield targets whose RRMSD by the rays of the proof is not that of the designed lens by flux tubes.

    Tubes do not know what the proof does: a refractive index that is wrong by 5 % in the proof alone is found.
    """
    channels = design.scene.channels(POINTS)
    tubes = round(side_factor(channels) * TUBES)
    for goal, figures in zip(design._made.goals, report.goals, strict=True):
        by_tubes, noise = rrmsd_by_tubes(design.lens, channels, goal, tubes), 3 * figures.rrmsd_standard_error
        if not abs(figures.rrmsd - by_tubes) <= MAX_DIFFERENCE + MAX_RELATIVE_DIFFERENCE * by_tubes + noise:
            yield f"{goal.key}: RRMSD {figures.rrmsd:.3f} in the proof, {by_tubes:.3f} by flux tubes"


def _failed(report, chosen):
    """The failed checks of a report as sentences, but for those that are true."""
    return [
        f"{check.name}: {check.value} ({check.limit}) {check.where}"
        for check in report.checks
        if not check.passed and not any(_holds(name, choices, check.name, chosen) for name, choices, _ in MAY_FAIL)
    ]


def _holds(pattern, choices, text, chosen):
    return bool(re.match(pattern, text)) and choices.items() <= chosen.items()


def test_the_array_has_all_pairs_and_no_refused_ones():
    pairs = {pair for scene in PAIRS for pair in map(frozenset, itertools.combinations(scene.items(), 2))}
    count = sum(len(CHOICES[a]) * len(CHOICES[b]) for a, b in itertools.combinations(CHOICES, 2))
    assert len(pairs) == count - len(REFUSED) and not any(together in pairs for together in map(frozenset, REFUSED))
    assert math.prod(sorted(map(len, CHOICES.values()))[-2:]) <= len(PAIRS) + 3  # nearly the least number of scenes


@pytest.mark.parametrize("together", REFUSED, ids=lambda together: " and ".join(sorted(dict(together).values())))
def test_a_refusal_names_both_keys(together, tmp_path, capsys):
    plain = PLAIN | ({"light": "cone", "rim": "circle"} if ("back", "dome") in together else {})
    plain |= {"light": "cone"} if ("medium", "encapsulant") in together else {}
    with pytest.raises(SceneError) as refusal:
        scene_of(plain | dict(together))
    of_dome = {"toroid": "lens.front.kind", "free sphere": "lens.front.kind", "dome before": "before"}
    of_dome |= dict.fromkeys(("spline file", "tailored spline", "mirror behind glass"), "lens.front.kind")
    of_dome |= {"dome": "dome"} if ("mount", "cut") in together else {}
    of_lamp = {"dome before": "before"}
    named = of_dome if ("back", "dome") in together else of_lamp
    assert all(named.get(value, NAMED[choice]) in str(refusal.value) for choice, value in together)


def test_each_value_is_previewed_planned_and_tailored_to_a_blank():
    all_values = {value for scene in PAIRS for value in scene.items()}
    for numbers in (PREVIEWED, PLANNED, RETAILORED):
        assert {value for k in numbers for value in PAIRS[k].items()} == all_values
        assert len(set(numbers)) == len(numbers) < len(PAIRS) / 4
    assert {value for scene in ONCE for value in scene.items()} == all_values and len(ONCE) < len(PAIRS) / 4


@pytest.mark.parametrize("number", range(len(ONCE)))
def test_each_value(number, tmp_path):
    done = {kind: number % 3 == k for k, kind in enumerate(("previewed", "planned", "retailored"))}
    _has_no_fault(ONCE[number], tmp_path, **done)


@pytest.mark.thorough
@pytest.mark.parametrize("number", range(len(PAIRS)))
def test_each_pair(number, tmp_path):
    kinds = {"previewed": PREVIEWED, "planned": PLANNED, "retailored": RETAILORED}
    _has_no_fault(PAIRS[number], tmp_path, **{kind: number in numbers for kind, numbers in kinds.items()})


def _has_no_fault(chosen, place, **done):
    assert faults(chosen, place / "out", **done) == [], chosen
    gc.collect()
    gc.freeze()  # kernels and modules that it loaded stay: they are walked over once


DENSE = {  # four control points per pixel along a side, and evaluations enough to ripple between the pixels
    "lens.back.control_points": 65, "target.pixels": 16, "tailoring.rays": 192, "tailoring.stage2_iterations": 25,
    "tailoring.transport_grid": 64,
}  # fmt: skip
MAX_HALF_RATIO, MAX_HALF = 2.0, 0.01  # RRMSD on half pixels: largest multiple of that on pixels, and what is added
MAX_HALF_RATIO_OF_ALL, MAX_HALF_OF_ALL = 2.5, 0.1  # both for every pair, after two evaluations


@pytest.mark.parametrize(("wall", "picture"), [("square", "even"), ("directions", "letters")])
@pytest.mark.parametrize("light", suite.in_turns(CHOICES["light"], 3))
def test_each_light_is_right_inside_the_pixels(light, wall, picture):
    """Without cells in the merit, even light deviates by 0.05 on half pixels, and letters by 0.2."""
    scene = scene_of(PLAIN | {"light": light, "wall": wall, "picture": picture}).changed(DENSE)
    made = pipeline.design(scene, options=pipeline.DesignOptions(compare_later=True, effort=LITTLE))
    effort = Effort(512, accuracy=0.0, witness=False, cells=2)
    [found] = measure_goals(made.lens.plain(), scene.channels(), made.goals, effort, ghost=None, sampler=scene.sampler)
    noise = 3 * math.hypot(found.half.standard_error, MAX_HALF_RATIO * found.standard_error)
    assert found.half.rrmsd <= MAX_HALF_RATIO * found.rrmsd + MAX_HALF + noise


BODIES = {  # choices of a scene, by the body that it has
    "lens": {},
    "mirror": {"front": "mirror"},
    "glass mirror": {"front": "mirror behind glass"},
    "tailored front": {"front": "tailored spline"},
    "two faces": {"front": "tailored spline", "targets": "two"},
    "windows": {"elements": "window behind"},
    "dome": {"back": "dome", "light": "cone", "rim": "circle"},
}


@pytest.mark.parametrize("body", suite.in_turns(BODIES, 4))
def test_a_design_remains_the_design_of_its_folder(body, tmp_path):
    """Methods of a design work after it was written, opened, and written again: its net is equal to the last bit."""
    folder = tmp_path / "design"
    design = Design(designed_quickly(scene_of(PLAIN | BODIES[body])))
    report = design.write(folder, progress=False)
    again = bstcad.open(folder)
    assert np.array_equal(design.lens.back_net.control_points(), again.lens.back_net.control_points())
    for each in (design, again):
        verified = each.verify(progress=False)
        assert verified.rrmsd == pytest.approx(report.rrmsd, rel=1e-3)
        assert [check.passed for check in verified.checks if check.id == "irradiance"] == [True] * len(report.goals)
        assert each.solid().Volume() > 0 and each.picture().any() and each.write_part(tmp_path / "p.step").exists()
        if body != "dome":
            assert each.with_lens(each.lens).with_heights(each.lens.back.heights).lens is not None
    again.write(folder, progress=False)
    for each in (design, again, bstcad.open(folder)):
        assert all(path.exists() for path in each.export("points"))


REACHING = covering(to_cover(2, ("light", "rim", "wall", "back", "front", "medium", "elements")))
INDICES = (1.05, 1.3, 1.49, 2.0)  # indices of the encapsulant, from almost air to more than the lens


def widened(scene, wall):
    """The scene with a target that goes on beyond what glass can light."""
    target = scene.target
    far = {"directions": 85.0, "tilted": 120.0}.get(wall, 400.0)
    middle = [(low + high) / 2 for low, high in (target.x, target.y)]
    return scene.changed(
        {
            "target.uniform": True, "target.text": None, "target.pixels": 48,
            **{f"target.{axis}": [m - far, m + far] for axis, m in zip("xy", middle, strict=True)},
        }
    )  # fmt: skip


def landed_by_snell(lens, source, receiver, grazing):
    """Columns and rows (pixels) at which rays land from points of the last freeform face, turned every way there.

    At each point the face takes every slope up to 70 degrees at which no light leaves at more than `grazing`.
    """
    number, law = lens.tailored_numbers[-1], lens.last_tailored.law
    half = lens.last_tailored.outline.half_extent
    x, y = torch.meshgrid(*(torch.linspace(-h, h, 19, dtype=torch.float64) for h in half), indexing="ij")
    inside = lens.last_tailored.outline.contains(x, y)
    q_x, q_y, at = rays_to(source, lens, x=x, y=y, number=number)
    coming = source.rays_through(q_x, q_y, lens.entrance.z, 1.0)
    arriving = across(coming, lens.interfaces[:number]).alive & (source.irradiance(q_x, q_y, lens.entrance.z) > 0)
    lit = inside & at.alive & arriving
    tilt, turn = torch.meshgrid(
        torch.deg2rad(torch.linspace(0, 69.9, 71, dtype=torch.float64)),
        torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)[:-1], indexing="ij",
    )  # fmt: skip
    axes = torch.stack([tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()]).reshape(3, -1)
    d, where = at.direction[:, lit], at.position[:, lit]
    if at.chart is not HEIGHTS:  # slopes of a dome are measured from its sphere
        out = where / where.norm(dim=0)
        one = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)[:, None].expand_as(out), out, dim=0)
        one = one / one.norm(dim=0)
        normal = torch.einsum("kip,kj->ipj", torch.stack([one, torch.linalg.cross(out, one, dim=0), out]), axes)
    else:
        normal = axes[:, None, :].expand(3, d.shape[1], -1)
    normal = at.sense * normal
    cosine = (d[:, :, None] * normal).sum(0)
    d, eta = d[:, :, None].expand_as(normal), law.eta
    if law.reverses:
        turned, fine, sense = d - 2 * cosine * normal, cosine > 0, -at.sense
    else:
        square = 1 - eta**2 * (1 - cosine**2)
        fine = (cosine > 0) & (square > math.cos(grazing) ** 2)
        turned = eta * d + (square.clamp(min=0).sqrt() - eta * cosine) * normal
        sense = at.sense
    place = where[:, :, None].expand_as(normal)[:, fine]
    few = replace(
        at, position=place, direction=turned[:, fine], status=torch.zeros(place.shape[1], dtype=torch.uint8),
        flux=torch.ones(place.shape[1], dtype=torch.float64), sense=sense, chart=HEIGHTS,
    )  # fmt: skip
    landed = receiver.receiver.land(across(few, lens.unbounded().interfaces[number + 1 :]))
    column, row = receiver.pixels_of(landed.position[:, landed.alive])
    return column.floor().long(), row.floor().long()


@pytest.mark.parametrize(
    "number", suite.daily(range(len(REACHING)), holding_each_value(REACHING, suite.turn(len(REACHING))))
)
def test_what_a_face_can_light_is_not_called_dark(number):
    """Rays by Snell's law from each point of the face, for every slope, agree with the closed form of `reachable_part`.

    The light of the whole source counts, and not that of its centre alone.  A pixel at the edge of the reach may count
    as dark, since only a part of it can be lit.
    """
    chosen = REACHING[number]
    scene = scene_of(chosen)
    if chosen["medium"] == "encapsulant":
        scene = scene.changed({"lens.encapsulant": INDICES[number % len(INDICES)]})
    scene = widened(scene, chosen["wall"])
    [goal] = scene.goals
    try:
        part, _ = pipeline.reachable_part(scene, goal)
    except SceneError as refusal:
        assert "lens.back.half_angle" in str(refusal), refusal  # a dome whose outer light leads past the target
        return
    channels = scene.with_source_scaled(0.0).channels()
    light = max(channels, key=lambda channel: channel.weight)
    lens, grazing = light.through(scene.flat_lens(pipeline.REACH_NET)), math.radians(85.0)
    if scene.source.extent and not lens.last_tailored.law.reverses:
        grazing = grazing_of(light.index, [each.index for each in channels], spread_at(scene.light, lens))
    columns, rows = landed_by_snell(lens, light.source, goal.screen, grazing)
    there = (columns >= 0) & (columns < goal.screen.columns) & (rows >= 0) & (rows < goal.screen.rows)
    lit = np.zeros(goal.screen.shape, bool)
    lit[rows[there], columns[there]] = True
    called = np.ones_like(lit) if part is None else part
    assert lit.any() and not (lit & ~binary_dilation(called, iterations=3)).any()
    if lens.last_tailored.law.reverses or scene.lens.front.is_tailored or scene.lens.front.free:
        return  # the rays of one front, or of a mirror, do not land densely on all that can be lit
    whole = binary_dilation(binary_closing(np.pad(lit, 6), iterations=2), iterations=3)[6:-6, 6:-6]
    few = 0.01 if chosen["elements"] == "none" else 0.05  # a window shifts grazing light a little further
    assert (called & ~whole).sum() <= few * called.sum()


@pytest.mark.bench
def test_each_light_rim_and_front(tmp_path):
    scenes = covering(itertools.chain(to_cover(2), to_cover(3, TRIPLES)))
    found = {}
    for number, chosen in enumerate(scenes):
        try:
            found[number] = faults(chosen, tmp_path / str(number))
        except Exception as error:  # of each scene, not of the first alone
            found[number] = [f"{type(error).__name__}: {error}"]
        if found[number]:
            print(chosen, *found[number], sep="\n    ")
    print(f"{len(scenes)} scenes, {sum(map(bool, found.values()))} with faults")
    assert not any(found.values())
