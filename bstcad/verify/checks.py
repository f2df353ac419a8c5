"""The proof: what the written files hold, measured against what was designed.

Nothing here knows how the lens was found.  The net and knots are read by a parser that is not OCC, the surface is
sampled through OCC, the mesh is read back from the STL, and the irradiance is traced through the geometry of the STEP
file, by ray tubes and by rays that tailoring never saw.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from bstcad.cad import mesh as meshes
from bstcad.cad import part21, step
from bstcad.cad.step import StepLens
from bstcad.cad.volume import exact_volume
from bstcad.optics import tubes
from bstcad.optics.bspline import BSplineSurface, knots
from bstcad.optics.irradiance import Screen, rrmsd
from bstcad.optics.lens import Lens
from bstcad.optics.simulation import Simulation, simulate
from bstcad.optics.sources import Source
from bstcad.scene import Tolerances
from bstcad.verify.shape import describe

SAMPLES = 1 << 17  # points of the re-read face compared with the optimised surface
NET = 1e-11  # mm; what sixteen digits of text leave of a control point
NORMAL = 1e-9  # rad
BRIDGED = 5e-7  # mm; written with 1e-7
VOLUME = 1e-6  # relative
SINGLE = 2e-7  # of the largest coordinate: what float32 leaves of a vertex, on slopes too
RESOLVED = 5.0  # the RRMSD must be so many times its noise floor
UNSEEN = 1_000_003  # added to the seed: rays that tailoring never saw
TUBES = (1549, 2063, 3079, 4099, 6151)  # ray tubes a side; primes: no corner is one that tailoring used
RAYS = 2048  # a side of the window, for each of the two halves
RIPPLE = 2.0  # of the slope energy of the net's highest octave over that of the octave below
OCTAVES = 17  # control points a side of a net from which on its octaves are judged
AGREE = 1.5  # rays and tubes differ by no more than this times their noise
ROUNDING = 1e-9  # of the irradiance


@dataclass(frozen=True)
class Check:
    """One line of the verdict."""

    name: str
    value: float | bool | None  # None: could not be measured
    limit: float | bool | None  # None: stated, not judged
    unit: str
    passed: bool

    @classmethod
    def at_most(cls, name: str, value: float, limit: float | None, unit: str = "") -> Check:
        """Passes if value <= limit; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit, limit is None or bool(value <= limit))

    @classmethod
    def at_least(cls, name: str, value: float, limit: float | None, unit: str = "") -> Check:
        """Passes if value >= limit; a value that is not finite fails."""
        return cls._judged(name, value, limit, unit, limit is None or bool(value >= limit))

    @classmethod
    def _judged(cls, name: str, value: float, limit: float | None, unit: str, passed: bool) -> Check:
        """A value that is not finite was not measured: the file holds nothing of the kind."""
        finite = math.isfinite(value)
        return cls(name, float(value) if finite else None, limit, unit, passed and finite)

    @classmethod
    def true(cls, name: str, value: bool) -> Check:
        """Passes if it is so."""
        return cls(name, bool(value), True, "", bool(value))


@dataclass(frozen=True)
class Nominal:
    """What was designed: the surfaces the files are held to."""

    lens: Lens  # float64
    target: np.ndarray  # (pixels, pixels), row 0 = y max
    screen: Screen
    source: Source
    tolerances: Tolerances
    seed: int


@dataclass(frozen=True)
class Verification:
    """What the files of a design are worth."""

    checks: tuple[Check, ...]
    irradiance: np.ndarray  # (pixels, pixels) box pixels, scaled to the target's sum
    lens: Lens  # as re-read from the STEP file
    rrmsd: float
    rrmsd_tent: float
    rrmsd_noise: float
    efficiency: float
    flux: dict[str, float]
    rays: int
    tubes: int
    shape: dict[str, float | None]

    def facts(self) -> dict:
        """The part of report.json that verification answers for."""
        return {
            "passed": all(check.passed for check in self.checks),
            "rrmsd": self.rrmsd,
            "rrmsd_tent": self.rrmsd_tent,
            "rrmsd_noise": self.rrmsd_noise,
            "efficiency": self.efficiency,
            "flux": self.flux,
            "rays_traced": self.rays,
            "tubes_traced": self.tubes,
            "checks": [asdict(check) for check in self.checks],
            "shape": self.shape,
        }


def verify(folder: Path, nominal: Nominal) -> Verification:
    """Check lens.step and lens.stl in `folder` against the design; ValueError if one of them cannot be read at all."""
    reread = step.read(folder / "lens.step")
    text = reread.text
    lens = step.lens(reread, nominal.lens.index)
    light = _irradiance(lens, nominal)
    shape = describe(lens)
    checks = (
        *_file(text, nominal.lens),
        *_solid(reread, nominal),
        Check.at_least("smallest thickness", shape["thickness_min"], nominal.tolerances.min_thickness, "mm"),
        _ripple(shape, lens.back.m),
        *_mesh(folder / "lens.stl", lens),
        *light.checks(nominal.tolerances),
    )
    volume = {"volume": exact_volume(lens)}
    return Verification(
        checks, light.picture, lens, light.rrmsd, light.tent, light.noise, light.rays.efficiency, light.rays.flux,
        light.rays.rays, light.tubes, shape | volume,
    )  # fmt: skip


def examine(path: Path) -> list[Check]:
    """Check a STEP file by itself: what it holds, without a design to hold it to."""
    reread = step.read(path)
    text = reread.text
    lens = step.lens(reread, index=1.5)  # the index does not matter to the shape
    m = lens.back.m
    return [
        *_text(text, m),
        Check.true("solid valid", reread.solid.isValid()),
        Check.at_most("solid: gaps that edges and vertices bridge", step.tolerance(reread), BRIDGED, "mm"),
        Check.at_most(
            "STEP text against OCC: control points", _off(text.surface.control_points, reread.control_points), NET, "mm"
        ),
        Check.at_least("smallest thickness", describe(lens)["thickness_min"], 0.0, "mm"),
    ]


def _text(text: part21.StepText, m: int) -> list[Check]:
    """Structure of the STEP file, read without OCC."""
    surface = text.surface
    ones = np.array([3, *[1] * (m - 3), 3])
    plain = surface.degrees == (2, 2) and not surface.rational
    plain &= all(np.array_equal(counts, ones) for counts in surface.multiplicities)
    return [
        Check.true("STEP text: one solid, in millimetres", text.solids == 1 and text.unit == "millimetre"),
        Check.true("STEP text: every edge used twice, once each way", text.closed),
        Check.true("STEP text: degree 2 x 2, multiplicities 3, 1, …, 1, 3", plain),
        Check.at_most("STEP text: knots", max(_off(full, knots(m)) for full in surface.full_knots), 0.0),
    ]


def _file(text: part21.StepText, lens: Lens) -> list[Check]:
    """The STEP file as text, held to the design."""
    off = _off(text.surface.control_points, lens.back.control_points())
    return [*_text(text, lens.back.m), Check.at_most("STEP text: control points", off, NET, "mm")]


def _off(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest absolute difference; infinite if the shapes differ."""
    return float(np.abs(found - wanted).max()) if found.shape == wanted.shape else float("inf")


def _solid(reread: StepLens, nominal: Nominal) -> list[Check]:
    """The re-read solid, its faces evaluated by OCC."""
    lens = nominal.lens
    form, normal = _form(reread, lens.back)
    curvature = abs(_curvature(reread.front) - _curvature(lens.front))
    return [
        Check.true("solid valid", reread.solid.isValid()),
        Check.at_most("solid: gaps that edges and vertices bridge", step.tolerance(reread), BRIDGED, "mm"),
        Check.at_most("form: re-read back face against the optimised one", form, nominal.tolerances.form, "mm"),
        Check.at_most("form: direction of the normals", normal, NORMAL, "rad"),
        Check.at_most("form: vertex of the front", abs(reread.front.z - lens.front.z), nominal.tolerances.form, "mm"),
        Check.at_most("form: curvature of the front", curvature, 1e-12, "1/mm"),
    ]


def _curvature(front: object) -> float:
    return float(getattr(front, "curvature", 0.0))


def _form(reread: StepLens, back: BSplineSurface) -> tuple[float, float]:
    """Largest distance in z (mm) and angle between normals (rad) over SAMPLES Sobol points of the whole net."""
    points = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(SAMPLES, dtype=torch.float64)
    x, y = (low + p * (high - low) for p, (low, high) in zip(points.T, (back.x, back.y), strict=True))
    found = step.sample(reread, x.numpy(), y.numpy())
    z, z_x, z_y = back.sag_and_slope(*(torch.from_numpy(found.points[:, i].copy()) for i in (0, 1)))
    wanted = torch.nn.functional.normalize(torch.stack([-z_x, -z_y, torch.ones_like(z)], dim=1), dim=1).numpy()
    sideways = max(np.abs(found.points[:, 0] - x.numpy()).max(), np.abs(found.points[:, 1] - y.numpy()).max())
    form = np.abs(found.points[:, 2] - z.numpy()).max()
    return float(max(form, sideways)), float(np.linalg.norm(found.normals - wanted, axis=1).max())


def _ripple(shape: dict[str, float | None], m: int) -> Check:
    """The spectrum of the net has to fall off: control points that go up and down in turn are no lens surface.

    A crease (slope ∝ 1 / k) gives 0.7 to 1, white noise of the slopes 4, of the heights 16.
    """
    top, below = shape["slope_energy_top_octave"], shape["slope_energy_octave_below"]
    ratio = top / below if below > 0 else 0.0
    limit = RIPPLE if m >= OCTAVES else None  # a coarse net has too few octaves to say
    return Check.at_most("ripple: slope energy of the net's highest octave over the one below", ratio, limit)


def _mesh(path: Path, lens: Lens) -> list[Check]:
    """The STL file against the re-read solid."""
    mesh = meshes.read_stl(path)
    size = float(np.abs(mesh.vertices).max(initial=0.0))
    volume = meshes.volume(mesh) / exact_volume(lens)
    return [
        Check.true("STL watertight, winding consistent", mesh.is_watertight and mesh.is_winding_consistent),
        Check.at_most("STL: volume against the solid's, relative", abs(volume - 1), VOLUME),
        Check.at_most("STL: vertices off the solid's faces", meshes.vertex_error(mesh, lens), SINGLE * size, "mm"),
        Check.at_most("STL: chordal error", meshes.chordal_error(mesh, lens), None, "mm"),
    ]


@dataclass(frozen=True)
class _Light:
    """Irradiance through the re-read geometry: by ray tubes, and by rays that share nothing with them but the trace."""

    picture: np.ndarray  # by tubes, scaled to the target's sum
    rrmsd: float
    noise: float  # RRMSD of the finest tubes against those a step coarser
    tubes: int  # how many
    rays: Simulation  # one half of them; its ledger and efficiency agree with the other's to the noise
    tent: float  # RRMSD of the rays by tent binning
    disagreement: float  # of rays and tubes, in units of their noise
    few: float  # 1, and more where few pixels leave the noise itself uncertain

    def checks(self, tolerances: Tolerances) -> list[Check]:
        closure = abs(sum(self.rays.flux.values()) - 1)
        return [
            Check.at_most("RRMSD, box pixels, through the re-read STEP", self.rrmsd, tolerances.rrmsd),
            Check.at_most("noise floor of that RRMSD, times five", RESOLVED * self.noise, self.rrmsd),
            Check.at_most(
                "irradiance by stratified rays against ray tubes, over the noise", self.disagreement, AGREE * self.few
            ),
            Check.at_least("efficiency", self.rays.efficiency, tolerances.efficiency),
            Check.at_most("flux ledger: distance of its sum from 1", closure, 1e-12),
        ]


def _irradiance(lens: Lens, nominal: Nominal) -> _Light:
    """By as many tubes as bring the noise floor below a fifth of the RRMSD, at most the last of TUBES; and by rays."""
    target = torch.from_numpy(nominal.target)
    size = torch.linalg.vector_norm(target)
    finest = None
    for n in TUBES:
        coarser, finest = finest, _scaled(tubes.picture(nominal.source, lens, nominal.screen, n), target)
        found = float(rrmsd(finest, target))
        noise = math.inf if coarser is None else float(torch.linalg.vector_norm(finest - coarser) / size)
        if RESOLVED * noise <= found:
            break
    halves = [simulate(nominal.source, lens, nominal.screen, RAYS, nominal.seed + UNSEEN + i) for i in (0, 1)]
    box, tent = (sum(getattr(half, kind) for half in halves) / 2 for kind in ("box", "tent"))
    # the difference of two halves has twice the deviation of their mean
    ray_noise = float(
        torch.linalg.vector_norm(_scaled(halves[0].box, target) - _scaled(halves[1].box, target)) / size / 2
    )
    apart = float(torch.linalg.vector_norm(_scaled(box, target) - finest) / size)
    return _Light(
        finest.numpy(), found, noise, n * n, halves[0], float(rrmsd(tent, target)),
        apart / max(math.hypot(ray_noise, noise), ROUNDING), 1 + 3 / nominal.screen.pixels,
    )  # fmt: skip


def _scaled(picture: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The picture with the target's sum."""
    if not picture.sum() > 0:
        raise ValueError("lens.step: none of its light falls on the target; write it again, or check scene.toml")
    return picture * (target.sum() / picture.sum())
