"""The output folder: a design is written beside it, moved into place whole, and proved from its files.

The old folder stays unharmed until the new one is complete: the new one is built under a temporary name beside it and
flushed to disk; then the two change places in one step.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import hashlib
import io
import itertools
import math
import os
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bstcad import files
from bstcad.cad import mesh as meshes
from bstcad.cad import mesh_files
from bstcad.cad.mesh_files import SILVER, Label
from bstcad.optics.bspline import DEGREE, BSplineSurface, knots
from bstcad.optics.lens import Lens
from bstcad.optics.measure import FULL
from bstcad.optics.surfaces import Surface
from bstcad.report.prescription import scene_text
from bstcad.report.record import Making
from bstcad.runs.worker import Submit, here, runs
from bstcad.scene import scene as scenes
from bstcad.scene.blank import NET_FILE as FRONT
from bstcad.scene.errors import MachineError, SceneError
from bstcad.transport.mapping import TransportMap, nodes
from bstcad.verify.checks import Nominal

SCENE, PART = "scene.toml", "part.step"
PROVEN = ("scene.toml", "design.npz", "lens.step", "lens.stl", PART, FRONT)  # the files that a verification reads
ROUGH = 0.01  # standard error of a draft's RRMSD, relative to it, at which the proof ends


@dataclass(frozen=True)
class Made:
    """A designed lens, as a folder holds it."""

    scene: scenes.Scene
    lens: Lens  # float64, on the CPU
    target: np.ndarray  # as scene.target.irradiance()
    making: Making = Making()  # stages, history and machine, for the report
    device: str = "cpu"  # of the design
    transport: TransportMap | None = None  # the map of stage 1; None for a lens of the user's own, or if not known

    @property
    def optic(self) -> str:
        """ "lens" or "mirror"."""
        return self.scene.optic


@contextlib.contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """A temporary sibling of `folder` that takes its place when the block ends without an error."""
    folder = folder.resolve()  # "." has no name, and a link is to lead to the new design
    folder.parent.mkdir(parents=True, exist_ok=True)
    tidy(folder)
    building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-{os.getpid()}-", dir=folder.parent))
    try:
        building.chmod(0o755)  # mkdtemp's folder is private to the user
        yield building
        for path in building.rglob("*"):
            if path.is_file():
                _flush(path)
        if not (folder.exists() and _exchange(building, folder)):
            _by_two_renames(building, folder)
        _flush(folder.parent)
    except OSError as error:
        if error.filename is None or str(building) in str(error.filename):  # the user knows no temporary name
            error.filename = str(folder)
        raise
    finally:
        shutil.rmtree(building, ignore_errors=True)  # the old design, or the unfinished new one


@contextlib.contextmanager
def amending(folder: Path) -> Iterator[Path]:
    """A temporary folder whose files go into `folder` when the block ends without an error.

    SceneError, and no file goes there, if another design or other files came into the folder meanwhile.
    """
    with _opened(folder) as place, tempfile.TemporaryDirectory(prefix="bstcad-") as building:
        before = _identity(folder)
        try:
            yield Path(building)
        except (OSError, ValueError):
            _check_same(folder, before)
            raise
        _check_same(folder, before)
        for path in sorted(Path(building).rglob("*")):
            if path.is_dir():
                files.folder_in_place(place / path.relative_to(building))
            else:
                files.put(place / path.relative_to(building), path.read_bytes())


@contextlib.contextmanager
def apart(folder: Path, place: Path) -> Iterator[Path]:
    """A temporary folder that replaces `place`, for the verification of a made part of the design in `folder`.

    SceneError if `place` holds anything but an earlier such verification, or if the design changed meanwhile.
    """
    try:
        files.check_free(place, files.PART, "a made part's")
    except ValueError as error:
        raise SceneError(error) from None
    before = _identity(folder)
    with replacing(place) as building:
        yield building
        _check_same(folder, before)


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[Path]:
    """A path that follows the folder wherever it is moved (Linux); on other systems `folder` itself."""
    if not Path("/proc/self/fd").is_dir():
        yield folder
        return
    handle = os.open(folder, os.O_RDONLY)  # while it is open no other folder gets its inode
    try:
        yield Path(f"/proc/self/fd/{handle}")
    finally:
        os.close(handle)


def _identity(folder: Path) -> list[tuple[int, ...] | None]:
    """Device and inode of the folder; of each file of PROVEN its size and time, too."""
    found: list[tuple[int, ...] | None] = []
    for path in (folder, *(folder / name for name in PROVEN)):
        try:
            it = path.stat()
        except OSError:
            found.append(None)
        else:
            found.append((it.st_dev, it.st_ino, *(() if path == folder else (it.st_size, it.st_mtime_ns))))
    return found


def _check_same(folder: Path, before: list[tuple[int, ...] | None]) -> None:
    if _identity(folder) != before:
        raise SceneError(
            f"{folder}: another design came there while this one was verified; nothing is written, verify it again"
        ) from None


def tidy(folder: Path) -> None:
    """Remove the temporary folders of killed processes beside `folder`; put back a design that one had moved aside."""
    folder = folder.resolve()
    for path in folder.parent.glob(f".{glob.escape(folder.name)}[.-]*"):
        found = re.fullmatch(r"(?:\.checkpoint)?-(\d+)(?:-[^-]*)?(-old)?", path.name[len(folder.name) + 1 :])
        if found is None or runs(int(found.group(1))):
            continue
        if found.group(2) and not folder.exists():
            path.rename(folder)
        elif path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _exchange(one: Path, other: Path) -> bool:
    """Let two folders change places in one step; False where the system cannot (Linux can: renameat2)."""
    here, swap = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return rename(here, os.fsencode(one), here, os.fsencode(other), swap) == 0


def _by_two_renames(building: Path, folder: Path) -> None:
    """Replace in two renames; if the process is killed between them, `tidy` puts the old folder back."""
    old = building.with_name(building.name + "-old")
    if folder.exists():
        folder.rename(old)
    try:
        os.replace(building, folder)
    except BaseException:
        if old.exists():
            old.rename(folder)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def scene_files(scene: scenes.Scene) -> dict[str, bytes]:
    """scene.toml and the files that it names, by file name; a folder of them loads to the same scene."""
    contents = {SCENE: scene.toml().encode()}
    if scene.target.image is not None:
        contents[scene.target.image.name] = scene.target.image.data
    if scene.lens.front.given is not None:
        contents[FRONT] = scene.lens.front.given.archive()
    return contents


def hash_of(contents: Mapping[str, bytes]) -> str:
    """SHA-256 of files by name."""
    digest = hashlib.sha256()
    for name, data in sorted(contents.items()):
        digest.update(name.encode() + data)
    return digest.hexdigest()


def now(work: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function at once."""
    return work(*arguments)


def write_geometry(design: Made, folder: Path, submit: Submit = here, beside: Callable[..., Any] = now) -> None:
    """Write lens.step, lens.stl, lens.3mf, part.step of a mount, and the scene with the files that it names.

    submit: bstcad.runs.worker.submit has the second process write STEP, while this one writes meshes.
    beside: calls a function with its arguments, now or later, for lens.3mf, which no proof reads.
    """
    step = submit(
        "bstcad.cad.step_writing.write_lens", design.lens, (folder / "lens.step").absolute(), design.scene.name,
        design.scene.part.of(design.scene.lens),
    )  # fmt: skip
    mount = design.scene.mount
    part = mount and submit(
        "bstcad.cad.mounting.write_if_it_fits", design.lens, mount, (folder / PART).absolute(), design.scene.name,
        design.scene.part.of(design.scene.lens),
    )  # fmt: skip
    asked = design.scene.output.mesh_tolerance is not None
    _, mesh = meshes.fitting(design.lens, design.scene.mesh_tolerance, meshes.ASKED if asked else None)
    mesh_files.write_stl(mesh, folder / "lens.stl")
    beside(mesh_files.write_3mf, mesh, folder / "lens.3mf", label(design.scene))
    _write_scene(design, folder)
    try:
        step.result()
        if part is not None:
            part.result()
    except BrokenExecutor as error:
        raise MachineError("OCC broke down over this solid, or its memory ran out; free some and try again") from error


def _write_scene(design: Made, folder: Path) -> None:
    """scene.toml with the numbers found for the front, and the files that it names."""
    contents = scene_files(design.scene) | {SCENE: scene_text(design.scene, design.lens).encode()}
    for name, data in contents.items():
        (folder / name).write_bytes(data)


def keep(design: Made, folder: Path) -> Path:
    """Keep a design that could not be written: its scene and design.npz, without the irradiance, which is not traced.

    In a folder beside `folder`, or, if that fails, among the system's temporary files; OSError.
    """

    def write(place: Path) -> None:
        _write_scene(design, place)
        write_design(design, None, place)

    kept = next(place for place in _kept(folder) if not place.exists() or _holds(place, design))
    try:
        with replacing(kept) as building:
            write(building)
    except OSError:
        kept = Path(tempfile.mkdtemp(prefix="bstcad-")) / kept.name
        try:
            kept.mkdir()
            write(kept)
        except BaseException:
            shutil.rmtree(kept.parent, ignore_errors=True)
            raise
    return kept


def forget_kept(design: Made, folder: Path) -> None:
    """Remove the folders that `keep` made beside `folder` for a design that is written now."""
    for place in itertools.takewhile(Path.exists, _kept(folder)):
        if _holds(place, design):
            shutil.rmtree(place, ignore_errors=True)


def _kept(folder: Path) -> Iterator[Path]:
    """The folders beside `folder` for designs that could not be written to it, in their order."""
    folder = folder.resolve()
    for k in itertools.count(1):
        yield folder.with_name(f"{folder.name}-unwritten{'' if k == 1 else f'-{k}'}")


def _holds(kept: Path, design: Made) -> bool:
    """Does a folder hold this design, to the last bit and for the same scene?"""
    try:
        scene, nominal = read_nominal(kept)
    except Exception:  # zipfile and numpy each raise their own for a damaged file
        return False
    return (
        np.array_equal(nominal.lens.back.control_points(), design.lens.back.control_points())
        and np.array_equal(nominal.stored_target, design.target)
        and scene.lens == design.scene.lens
        and scene.source == design.scene.source
    )


def label(scene: scenes.Scene) -> Label:
    """Name and colour of a mesh of the scene's lens."""
    if scene.optic == "mirror":
        return Label(scene.name, scene.title, "mirror", SILVER)
    return Label(scene.name, scene.title, scene.lens.material or "glass")


def write_design(design: Made, irradiance: np.ndarray | None, folder: Path) -> None:
    """design.npz: the optimised surfaces, the target, the irradiance if it is traced, and the scene's text.

    The transport map, if known (TransportMap): transport_x (c,) and transport_y (r,), mm on the target;
    transport_back or transport_entrance (c, r, 2), x and y (mm) where the light for them passes the back, or the
    plane of the first vertex.
    """
    m, front = design.lens.back.m, design.lens.front
    given = {"front_control_points": front.control_points()} if front.curvature is None else {}
    sent = design.transport
    np.savez_compressed(
        folder / "design.npz",
        control_points=design.lens.back.control_points(),
        knots_x=knots(m),
        knots_y=knots(m),
        degree=DEGREE,
        **({"front_curvature": 0.0} | _numbers(front) | given),
        target=design.target,
        **({} if irradiance is None else {"irradiance": irradiance}),
        scene=scene_text(design.scene, design.lens),
        **({f"transport_{sent.plane}": sent.source, "transport_x": sent.x, "transport_y": sent.y} if sent else {}),
    )


def read_nominal(folder: Path) -> tuple[scenes.Scene, Nominal]:
    """Scene and nominal design of a folder; SceneError if design.npz or scene.toml is missing or damaged."""
    scene = scenes.load(folder / "scene.toml")
    path = folder / "design.npz"
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    shapes = {"control_points": (m, m, 3), "target": (rows, columns), "front_curvature": ()}
    shapes |= dict.fromkeys(_numbers(scene.lens.front.surface), ())
    found = _arrays(path, shapes, scene)
    if not found["target"].sum() > 0:
        raise SceneError(f"{path}: the target is all black; generate the design again")
    lens = lens_of(scene, found)
    return scene, nominal(scene, lens, found["target"])


def read_irradiance(folder: Path, scene: scenes.Scene) -> np.ndarray:
    """The irradiance through the written lens; SceneError if design.npz is damaged."""
    path, (columns, rows) = folder / "design.npz", scene.target.columns_rows
    found = _arrays(path, {"irradiance": (rows, columns)}, scene)["irradiance"]
    if not (found.min() >= 0 and found.sum() > 0):
        raise SceneError(f"{path}: its irradiance is none; generate the design again")
    return found


def read_transport(folder: Path, scene: scenes.Scene) -> TransportMap | None:
    """The transport map of a design, None if design.npz has none; SceneError if it is damaged."""
    path, (columns, rows) = folder / "design.npz", (nodes(n).size for n in scene.target.columns_rows)
    for plane in ("back", "entrance"):
        if f"transport_{plane}.npy" in _members(path):
            shapes = {"transport_x": (columns,), "transport_y": (rows,), f"transport_{plane}": (columns, rows, 2)}
            x, y, source = _arrays(path, shapes, scene).values()
            return TransportMap(x, y, source.astype(np.float32), plane)
    return None


def _members(path: Path) -> list[str]:
    """The files in an archive; [] for other files."""
    try:
        with zipfile.ZipFile(io.BytesIO(files.contents(path, files.LARGEST))) as archive:
            return archive.namelist()
    except (ValueError, zipfile.BadZipFile):
        return []


def _arrays(path: Path, shapes: Mapping[str, tuple[int, ...]], scene: scenes.Scene) -> dict[str, np.ndarray]:
    """Arrays of finite numbers out of the design.npz of a scene."""
    m, (columns, rows) = scene.lens.back.control_points, scene.target.columns_rows
    given = scene.lens.front.given
    m = math.hypot(m, given.m if given else 0)  # of both nets together
    try:
        found = files.arrays(path, shapes, 25 * m * m + 17 * columns * rows + 3_000_000)  # with what is not read
    except Exception as error:  # numpy, zipfile, zlib and tokenize each raise their own for a damaged file
        raise SceneError(f"{path}: cannot be read ({_first_line(error)}); generate the design again") from None
    for name, shape in shapes.items():
        if not np.isfinite(found[name]).all():
            raise SceneError(f"{path}: {name} is not {shape} finite numbers; generate the design again")
    return found


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def _numbers(front: Surface) -> dict[str, float]:
    """Parameters of a front with few of them, by their names in design.npz."""
    return {f"front_{name}": value for name, value in front.plain().parameters().items() if isinstance(value, float)}


def lens_of(scene: scenes.Scene, found: Mapping[str, np.ndarray]) -> Lens:
    """The designed lens, to the last bit, from its control net (m, m, 3) in mm and the numbers of its front."""
    net, z = found["control_points"], scene.lens.back.z
    if not np.array_equal(z + (net[..., 2] - z), net[..., 2]):  # where the two differ much in size a bit would be lost
        z = 0.0
    front = scene.lens.front.surface
    front = front.with_parameters(**{name.removeprefix("front_"): float(found[name]) for name in _numbers(front)})
    back = BSplineSurface.from_control_points(net, z)
    return scene.as_mounted(Lens(front, back, scene.lens.outline, scene.index, reflects=scene.lens.back.reflect))


def nominal(scene: scenes.Scene, lens: Lens, stored_target: np.ndarray) -> Nominal:
    """The design that the files are held to; its target is the scene's own, whatever design.npz stores."""
    return Nominal(
        lens=lens,
        target=scene.target.irradiance(),
        screen=scene.target.screen,
        channels=scene.judging_channels(),
        accept=scene.accept,
        seed=scene.tailoring.seed,
        stored_target=stored_target,
        mesh_tolerance=scene.mesh_tolerance,
        mesh_asked=scene.output.mesh_tolerance is not None,
        ghost=scene.ghost,
        mount=scene.mount,
        blank=scene.lens,
        part=scene.part.of(scene.lens),
        draw=scene.draw,
        accuracy=ROUGH if scene.tailoring.quality == "draft" else FULL.accuracy,
    )
