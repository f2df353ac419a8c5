"""The files that a scene names: copied beside a design, and each byte of them tells two designs apart."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from bstcad import commands
from bstcad.analysis.shape import describe
from bstcad.designs.folder import scene_files
from bstcad.designs.pipeline import DesignState, purpose
from bstcad.optics.light.point import PointSource
from bstcad.optics.surfaces.key import Key
from bstcad.report.prescription import prescription
from bstcad.runs import checkpoint, files
from bstcad.scene.scene import Scene, load
from bstcad.scene.schema import FileContent, from_file
from bstcad.tailoring.driver import DesignRecord
from tests.conftest import DISK

RAMP = np.linspace(0.1, 1.0, 12).reshape(3, 4)


@dataclass(frozen=True)
class Table(FileContent):
    """Intensities of a lamp."""

    name: str
    data: bytes = field(repr=False)


TableFile = Annotated[Table, *from_file(Table, lambda path: Table(path.name, path.read_bytes()), "table = 'lamp.ies'")]


@dataclass(frozen=True)
class Lamp(PointSource):
    """A point source with a table of intensities."""

    table: Annotated[TableFile | None, Key("The intensities.")] = None


class LitScene(Scene):
    """A scene whose source is such a lamp."""

    source: Lamp


def other_byte(data: bytes) -> bytes:
    """Return the bytes, the last one changed."""
    return data[:-1] + bytes([data[-1] ^ 1])


def a_net(folder: Path) -> Path:
    """Write the net of an earlier design; its folder."""
    x, y = np.meshgrid(np.linspace(-16, 16, 9), np.linspace(-16, 16, 9), indexing="ij")
    np.savez(folder / "design.npz", control_points=np.stack([x, y, 0.0002 * (x**2 + y**2)], axis=-1))
    return folder


@pytest.mark.parametrize("part", ["picture", "front"])
def test_a_design_does_not_resume_with_a_byte_of_a_file_changed(part, tmp_path):
    front = {"kind": "bspline", "z": 15.0, "file": str(a_net(tmp_path))}
    scene = load(DISK).changed({"target.image": RAMP, "target.outline": None, "lens.front": front})
    image, net = scene.target.image, scene.lens.front.file
    change = {
        "picture": {"target.image": replace(image, data=other_byte(image.data))},
        "front": {"lens.front.file": replace(net, data=other_byte(net.data))},
    }[part]
    assert purpose(scene.changed({}), "cpu") == purpose(scene, "cpu")
    checkpoint.write(files.beside(tmp_path / "lens", "checkpoint"), purpose(scene, "cpu"), DesignState(DesignRecord()))
    with pytest.raises(files.SceneError, match="is of another design .files"):
        commands.generate(scene.changed(change), tmp_path / "lens", device="cpu", resume=True)


def test_a_file_of_a_record_of_ones_own_is_copied_and_hashed(tmp_path):
    def lit(folder: Path) -> Scene:
        data = json.loads((tmp_path / "scene.json").read_text())
        return LitScene.model_validate_json(json.dumps(data), strict=True, context={"folder": folder})

    data = load(DISK).model_dump(mode="json", exclude_none=True)
    data["source"]["table"] = "lamp.ies"
    (tmp_path / "scene.json").write_text(json.dumps(data))
    (tmp_path / "lamp.ies").write_bytes(b"IESNA:LM-63-2002")
    scene = lit(tmp_path)
    lens = scene.flat_lens(9)
    source = prescription(scene, lens, describe(lens) | {"volume": 1.0})["source"]
    assert source["table"] == "lamp.ies"
    copies = scene_files(scene)
    assert copies.keys() == {"scene.toml", "lamp.ies"} and 'table = "lamp.ies"' in copies["scene.toml"].decode()
    (copy := tmp_path / "copy").mkdir()
    (copy / "lamp.ies").write_bytes(copies["lamp.ies"])
    assert lit(copy) == scene and purpose(lit(copy), "cpu") == purpose(scene, "cpu")
    (copy / "lamp.ies").write_bytes(other_byte(copies["lamp.ies"]))
    assert purpose(lit(copy), "cpu") != purpose(scene, "cpu")
