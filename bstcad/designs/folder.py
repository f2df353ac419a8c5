"""The folder of a design: written completely or not at all, and read back to the last bit.

A new folder is built under a temporary name beside the old folder and flushed to disk.  Then the folders are exchanged
in one step; until then the old folder stays intact.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import hashlib
import itertools
import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bstcad.cad import mesh as meshes
from bstcad.cad.mesh import MIRROR_RGBA, Label
from bstcad.designs.as_designed import scene_text
from bstcad.designs.designed_lens import DesignedLens
from bstcad.optics.lens import face_integrals
from bstcad.optics.lens.lens import Lens
from bstcad.optics.lens.passes import FRONT
from bstcad.optics.surfaces.bspline import DEGREE, BSplineSurface, is_net, knots
from bstcad.optics.surfaces.radial import RadialSurface
from bstcad.optics.surfaces.sides import Sides, as_pair, scaled
from bstcad.optics.surfaces.surfaces import Surface
from bstcad.optics.trace.measure import Light
from bstcad.runs import files
from bstcad.runs.files import MachineError, SceneError
from bstcad.runs.processes import Submit, is_alive, run_here
from bstcad.scene import scene as scenes
from bstcad.scene.fronts import NET_FILE
from bstcad.scene.target import numbered
from bstcad.transport.mapping import AT_ENTRANCE, AT_FACE, TransportMap, nodes
from bstcad.verify import jobs
from bstcad.verify.nominal import Nominal

SCENE, DESIGN, PART = "scene.toml", "design.npz", "part.step"  # names of files in a design's folder
FRONT_KNOTS = ("front_knots_x", "front_knots_y")  # names in design.npz of the knots of a tailored front
PROVEN = (SCENE, DESIGN, "lens.step", "lens.stl", PART, NET_FILE)  # files that a verification reads
ERROR = "irradiance_error"  # name in design.npz of the error of the irradiance
DISTANCES = "relative_distances"  # name in design.npz of a dome's distances
# Arrays of design.npz: shape and meaning.  The back has m x n control points, the front m' x n'; rows and columns are
# pixels of a target, c and r numbers of points on it.  A second target has target_2, irradiance_2, and so on.
ARRAYS = {
    "control_points": ("(m, n, 3)", "x, y, z of the net of the back (mm); first axis along x, second along y"),
    "knots_x": ("(m + 3,)", "knots 0, 0, 0, 1, 2, …, m - 2, m - 2, m - 2 along x"),
    "knots_y": ("(n + 3,)", "knots along y, with n instead of m"),
    "degree": ("()", "integer 2"),
    DISTANCES: ("(m, n)", "of a dome: distances of its control points from the centre, minus lens.back.radius (mm)"),
    "front_curvature": ("()", "curvature of the front at its vertex (1/mm); no meaning for a net or a toroid"),
    "front_conic_constant": ("()", "conic constant of a conic front"),
    "front_control_points": ("(m', n', 3)", "x, y, z of the net of a freeform front or a toroid (mm)"),
    "front_knots_x": ("(m' + 3,)", "knots of a tailored front along x"),
    "front_knots_y": ("(n' + 3,)", "knots of a tailored front along y"),
    "target": ("(rows, columns)", "required flux in each pixel, of sum 1; row 0 = y max, column 0 = x min"),
    "irradiance": ("(rows, columns)", "flux in each pixel by rays through the written lens, of the target's sum"),
    ERROR: ("()", "RRMSD between `irradiance` and the light without noise"),
    "reachable": ("(rows, columns)", "uint8, 1 in pixels that light can reach; absent if it can reach all bright ones"),
    "transport_x": ("(c,)", "x of points on the target, corners of pixels (unit of the receiver)"),
    "transport_y": ("(r,)", "y of points on the target, corners of pixels (unit of the receiver)"),
    "transport_back": ("(c, r, 2)", "float32: x and y of their light on the last tailored face (mm)"),
    "transport_entrance": ("(c, r, 2)", "float32, for the paper's map: x and y (mm) in the plane of the first vertex"),
    "scene": ("()", "text of scene.toml"),
}
REMEDY = "generate the design again"


# --- estimates of file sizes ------------------------------------------------------------------------------------------

LARGE_STEP = 100e6  # smallest estimated size of lens.step (bytes) that is printed before a design
BYTES_PER_POINT = 83  # bytes of a point's STEP statement and of one reference to it (#N), without the digits of N
OTHER_BYTES = 103_000, 1600  # bytes of other statements: per file; for each net, per control point along its mean side


def step_size(scene: scenes.Scene, net: Sides | None = None) -> float:
    """Estimate the size of lens.step in bytes, to a few per cent: one statement and one reference per control point.

    net: control points per side, or along x and along y; None: as in the scene.
    """
    nets = map(as_pair, scene.lens.nets(net))
    constant, per_side = OTHER_BYTES
    return sum(m * n * (BYTES_PER_POINT + 2 * len(str(m * n))) + per_side * (m + n) / 2 for m, n in nets) + constant


def size_sentence(scene: scenes.Scene) -> str:
    """Return a sentence on the size of lens.step with the scene's control points, and with half as many per side."""
    net = scene.lens.back.net
    fewer = scaled(net, 0.5)
    full, half = (f"{step_size(scene, points) / 1e6:.3g} MB" for points in (net, fewer))
    m, n = as_pair(net)
    return (
        f"lens.step will have about {full} for {m} x {n} control points; lens.back.control_points = "
        f"{list(fewer) if isinstance(fewer, tuple) else fewer} would give {half}"
    )


# --- replacing an earlier folder --------------------------------------------------------------------------------------


@contextlib.contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `folder` when the block ends without an error."""
    folder = folder.resolve()  # "." has no name, and a symbolic link must lead to the new design
    folder.parent.mkdir(parents=True, exist_ok=True)
    tidy(folder)
    building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-{os.getpid()}-", dir=folder.parent))
    old = building.with_name(f"{building.name}-old")
    try:
        building.chmod(0o755)  # mkdtemp's folder is private to the user
        yield building
        for path in building.rglob("*"):
            if path.is_file():
                _flush(path)
        if not (folder.exists() and _exchange(building, folder)):
            if folder.exists():  # if the process is killed between two renames, `tidy` restores the old folder
                folder.rename(old)
            os.replace(building, folder)
        _flush(folder.parent)
    except OSError as error:
        if error.filename is None or str(building) in str(error.filename):  # the user does not know the temporary name
            error.filename = str(folder)
        raise
    finally:
        if old.exists() and not folder.exists():
            old.rename(folder)
        for path in (building, old):
            shutil.rmtree(path, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; return False if the system cannot (Linux can, with renameat2)."""
    at, swap = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    return rename is not None and rename(at, os.fsencode(one), at, os.fsencode(other), swap) == 0


def tidy(folder: Path) -> None:
    """Remove temporary folders of killed processes beside `folder`; restore a design that such a process had moved."""
    folder = folder.resolve()
    with contextlib.suppress(OSError):
        files.beside(folder, "checkpoint.new").unlink()
    for path in folder.parent.glob(f".{glob.escape(folder.name)}-*"):
        found = re.fullmatch(r"(\d+)-[^-]*(-old)?", path.name[len(folder.name) + 2 :])
        if found is None or is_alive(int(found.group(1))):
            continue
        if found.group(2) and not folder.exists():
            path.rename(folder)
        else:
            shutil.rmtree(path, ignore_errors=True)


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def amending(folder: Path, place: Path | None = None, *, into: Path | None = None) -> Iterator[Path]:
    """Yield a temporary folder; its files are moved to the design's folder `folder` if the block ends without an error.

    into: folder to which the files are moved instead, beside its other files; it is created if necessary.
    place: folder for the report of a made part; the temporary folder then replaces `place`, and `folder` is unchanged.
    SceneError if `place` has files of another kind, or if the design has changed meanwhile; nothing is then written.
    """
    if place is not None:
        files.check_free(place, files.MADE_PART_FILES, "a made part's")
    before = _stamps(folder)
    with tempfile.TemporaryDirectory(prefix="bstcad-") if place is None else replacing(place) as building:
        try:
            yield Path(building)
        except (OSError, ValueError):
            if _stamps(folder) == before:
                raise
        if _stamps(folder) != before:
            changed = "the design was replaced during this command, so nothing is written"
            raise SceneError(f"{folder}: {changed}; run the command again")
        goal = folder if into is None else into
        goal.mkdir(parents=True, exist_ok=True)
        for path in sorted(Path(building).rglob("*")) if place is None else ():
            if path.is_dir():
                files.folder_in_place(goal / path.relative_to(building))
            else:
                files.put(goal / path.relative_to(building), path.read_bytes())


def _stamps(folder: Path) -> list[tuple[object, ...]]:
    """Return device and inode of a folder and of its files in PROVEN, and the files' sizes and modification times."""
    found: list[tuple[object, ...]] = []
    for path in (folder, *(folder / name for name in PROVEN)):
        with contextlib.suppress(OSError):
            stat = path.stat()
            content = (stat.st_size, stat.st_mtime_ns) if path != folder else ()
            found.append((path, stat.st_dev, stat.st_ino, *content))
    return found


# --- writing ----------------------------------------------------------------------------------------------------------


def scene_files(scene: scenes.Scene) -> dict[str, bytes]:
    """Return scene.toml and the files that it names, by file name; the scene loaded from these files is equal."""
    return {SCENE: scene.toml().encode()} | {name: content.copy for name, content in scene.files.items()}


def hash_of(contents: Mapping[str, bytes]) -> str:
    """Return the SHA-256 of the names and contents of files."""
    digest = hashlib.sha256()
    for name, data in sorted(contents.items()):
        digest.update(name.encode() + data)
    return digest.hexdigest()


def write_geometry(design: DesignedLens, folder: Path, submit: Submit = run_here) -> Callable[[], None]:
    """Write lens.step, lens.stl, part.step if there is a mount, and the scene with the files that it names.

    Return the function that writes lens.3mf.  The verification does not read lens.3mf, so a thread can write it later.
    submit: calls the functions that write STEP; bstcad.runs.processes.submit calls them in a second process.
    """
    scene, lens = design.scene, design.lens
    stated = scene.name, scene.part.of(scene.lens)
    sums = face_integrals.of_lens(lens)  # computed in this process, which has loaded the kernels
    written = [submit(jobs.write_lens, lens, (folder / "lens.step").absolute(), *stated, sums)]
    if mount := scene.mount:
        written.append(submit(jobs.write_part, lens, mount, (folder / PART).absolute(), *stated))
    asked = scene.output.mesh_tolerance is not None
    _, mesh = meshes.fit_mesh(lens, scene.mesh_tolerance, meshes.MAX_TRIANGLES if asked else None)
    meshes.write_stl(mesh, folder / "lens.stl")
    _write_scene(design, folder)
    try:
        for step in written:
            step.result()
    except BrokenExecutor as error:
        crash = "OpenCASCADE crashed on this solid or ran out of memory"
        raise MachineError(f"{crash}; close other programs and try again; if it fails again, report it") from error
    return partial(meshes.write_3mf, mesh, folder / "lens.3mf", label(scene))


def label(scene: scenes.Scene) -> Label:
    """Return name, title, material and colour for the mesh files of the scene's lens."""
    if not scene.lens.passes.enters:
        return Label(scene.name, scene.title, "mirror", MIRROR_RGBA)
    return Label(scene.name, scene.title, scene.lens.material or "glass")


def _write_scene(design: DesignedLens, folder: Path) -> None:
    """Write scene.toml, with the designed parameters of the front, and the files that scene.toml names."""
    contents = scene_files(design.scene) | {SCENE: scene_text(design.scene, design.lens).encode()}
    for name, data in contents.items():
        (folder / name).write_bytes(data)


def write_design(design: DesignedLens, lights: Sequence[Light], folder: Path) -> None:
    """Write design.npz: the optimised surfaces, the pictures, and the scene's text.

    The arrays are those of ARRAYS.  lights: traced light on each target; () if not traced.  The last tailored face is
    the back; the front if only the front is tailored, or for a mirror behind glass.  The distances of a dome are stored
    since its control points, which are rounded, do not give them exactly.
    """
    lens, sent = design.lens, design.transport
    (m, n), front = lens.back_net.shape, lens.front
    parts = ((k, goal.reachable) for k, goal in enumerate(design.goals))
    arrays: dict[str, Any] = {
        "control_points": lens.back_net.control_points(),
        "knots_x": knots(m),
        "knots_y": knots(n),
        "degree": DEGREE,
        "front_curvature": 0.0,
        **_numbers(front),
        **({DISTANCES: lens.back_net.heights.cpu().double().numpy()} if not lens.back.chart.flat else {}),
        **({"front_control_points": front.control_points()} if is_net(front) else {}),
        **(dict(zip(FRONT_KNOTS, map(knots, lens.front_net.shape), strict=True)) if lens.is_tailored(FRONT) else {}),
        **{numbered("target", k): goal.picture for k, goal in enumerate(design.goals)},
        **{numbered("reachable", k): part.astype(np.uint8) for k, part in parts if part is not None},
        **{numbered("irradiance", k): light.picture for k, light in enumerate(lights)},
        **{numbered(ERROR, k): light.picture_error for k, light in enumerate(lights)},
        "scene": scene_text(design.scene, lens),
        **({f"transport_{sent.plane}": sent.source, "transport_x": sent.x, "transport_y": sent.y} if sent else {}),
    }
    np.savez_compressed(folder / DESIGN, **arrays)


@contextlib.contextmanager
def kept_if_unwritten(design: DesignedLens, folder: Path) -> Iterator[None]:
    """Keep a design that cannot be written to `folder` in a folder beside it, or else in the system's temporary folder.

    The scene and design.npz are kept, without irradiance.  A note on the error names the folder.
    """
    try:
        yield
    except Exception as error:
        with contextlib.suppress(OSError, MemoryError):  # no space anywhere: the original error matters more
            kept = _keep(design, folder)
            error.add_note(f"the finished design is kept in {kept}; bstcad.open and bstcad export can read this folder")
        raise
    for path in itertools.takewhile(Path.exists, _spare_folders(folder)):
        if _contains(path, design):
            shutil.rmtree(path, ignore_errors=True)


def _keep(design: DesignedLens, folder: Path) -> Path:
    """Write a design to a folder beside `folder`, or else in the system's temporary folder; return its path."""

    def write_to(path: Path) -> Path:
        with replacing(path) as building:
            _write_scene(design, building)
            write_design(design, (), building)
        return path

    beside = next(path for path in _spare_folders(folder) if not path.exists() or _contains(path, design))
    try:
        return write_to(beside)
    except OSError:
        return write_to(Path(tempfile.mkdtemp(prefix="bstcad-"), beside.name))


def _spare_folders(folder: Path) -> Iterator[Path]:
    """Yield paths beside `folder` for designs that could not be written to `folder`."""
    folder = folder.resolve()
    for k in itertools.count(1):
        yield folder.with_name(f"{folder.name}-unwritten{'' if k == 1 else f'-{k}'}")


def _contains(folder: Path, design: DesignedLens) -> bool:
    try:
        nominal = read_nominal(folder)
    except Exception:  # zipfile and numpy raise various errors for a damaged file
        return False
    return design.is_lens_of(nominal)


# --- reading ----------------------------------------------------------------------------------------------------------


def read_nominal(folder: Path) -> Nominal:
    """Return the nominal design of a folder.  SceneError if design.npz or scene.toml is missing or damaged."""
    scene = scenes.load(folder / SCENE)
    shapes: dict[str, tuple[int, ...]] = {"control_points": (*as_pair(scene.lens.back.net), 3), "front_curvature": ()}
    if scene.lens.front.is_tailored:
        shapes["front_control_points"] = (*as_pair(scene.lens.nets()[1]), 3)
    names = files.names(folder / DESIGN)
    if not scene.lens.back.chart.flat and DISTANCES in names:  # an earlier version stored the points alone
        shapes[DISTANCES] = as_pair(scene.lens.back.net)
    for k, target in enumerate(scene.targets):
        shapes[numbered("target", k)] = target.columns_rows[::-1]
        if (name := numbered("reachable", k)) in names:
            shapes[name] = target.columns_rows[::-1]
        for name, shape in {"irradiance": target.columns_rows[::-1], ERROR: ()}.items():
            if numbered(name, k) in names:  # an earlier version stored no error, and an unwritten design has no light
                shapes[numbered(name, k)] = shape
    found = _arrays(folder, shapes | dict.fromkeys(_numbers(scene.lens.front_surface), ()), scene)
    goals, stored, lit = [], [], []
    for k, goal in enumerate(scene.goals):
        part = found.get(numbered("reachable", k))
        goals.append(goal.restricted(None if part is None else part > 0))
        stored.append(found[numbered("target", k)])
        lit.append((found.get(numbered("irradiance", k)), float(found.get(numbered(ERROR, k), math.nan))))
        if not stored[k].sum() > 0 or not goals[k].picture.sum() > 0:
            raise SceneError(f"{folder / DESIGN}: the picture of {goal.key} is all black; {REMEDY}")
    return Nominal(scene, _lens(scene, found), tuple(goals), stored=tuple(stored), lit=tuple(lit))


def read_irradiances(folder: Path, scene: scenes.Scene) -> tuple[np.ndarray, ...]:
    """Return the irradiance (rows, columns) of the written lens on each target; SceneError if design.npz is damaged."""
    shapes = {numbered("irradiance", k): target.columns_rows[::-1] for k, target in enumerate(scene.targets)}
    arrays = _arrays(folder, shapes, scene)
    found = tuple(arrays[name] for name in shapes)
    if not all(each.min() >= 0 and each.sum() > 0 for each in found):
        raise SceneError(f"{folder / DESIGN}: the irradiance in this file is zero or has negative values; {REMEDY}")
    return found


def read_transport(folder: Path, scene: scenes.Scene) -> TransportMap | None:
    """Return the transport map of a design; None if design.npz has none.  SceneError if design.npz is damaged."""
    columns, rows = (nodes(n).size for n in scene.target.columns_rows)
    names = files.names(folder / DESIGN)
    for plane in (AT_FACE, AT_ENTRANCE):
        if (name := f"transport_{plane}") in names:
            shapes = {"transport_x": (columns,), "transport_y": (rows,), name: (columns, rows, 2)}
            x, y, source = _arrays(folder, shapes, scene).values()
            return TransportMap(x, y, source.astype(np.float32), plane)
    return None


def _arrays(folder: Path, shapes: Mapping[str, tuple[int, ...]], scene: scenes.Scene) -> dict[str, np.ndarray]:
    path, pixels = folder / DESIGN, sum(math.prod(target.columns_rows) for target in scene.targets)
    points = sum(math.prod(as_pair(net)) for net in scene.lens.nets())
    try:
        found = files.arrays(path, shapes, 33 * points + 17 * pixels + 3_000_000)  # limit in bytes
    except ValueError as error:
        raise SceneError(f"{path}: cannot be read ({files.first_line(error)}); {REMEDY}") from None
    for name, shape in shapes.items():
        if not np.isfinite(found[name]).all():
            raise SceneError(f"{path}: the array {name} of shape {shape} has values that are not finite; {REMEDY}")
    return found


def _numbers(front: Surface) -> dict[str, float]:
    """Return the parameters of an analytic front under their names in design.npz."""
    return {f"front_{name}": value for name, value in front.plain().parameters().items() if isinstance(value, float)}


def _lens(scene: scenes.Scene, found: Mapping[str, np.ndarray]) -> Lens:
    """Return the designed lens, to the last bit, from its control nets (m, n, 3) in mm and its front's parameters."""
    blank = scene.lens
    front = blank.front_surface
    if blank.front.is_tailored:
        front = _surface(found["front_control_points"], blank.front.z)
    else:
        front = front.with_parameters(**{name.removeprefix("front_"): float(found[name]) for name in _numbers(front)})
    if not blank.back.chart.flat:
        flat = scene.flat_lens(blank.back.net).with_front(front)
        try:
            return flat.with_back(RadialSurface.like(flat.back, found["control_points"], found.get(DISTANCES)))
        except ValueError as error:
            raise SceneError(f"{DESIGN}: {error}; {REMEDY}") from None
    back = _surface(found["control_points"], blank.back.z)
    return scene.assembled(Lens.between(front, back, blank.outline, scene.index, passes=blank.passes))


def _surface(net: np.ndarray, z: float) -> BSplineSurface:
    """Return the surface of a control net (m, n, 3) in mm, to the last bit; its z is 0 if `z` causes rounding."""
    if not np.array_equal(z + (net[..., 2] - z), net[..., 2]):  # heights relative to z would be rounded
        z = 0.0
    return BSplineSurface.from_control_points(net, z)
