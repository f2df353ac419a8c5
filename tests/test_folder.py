"""A design's folder: replaced whole or not at all, and read back as what was designed."""

from __future__ import annotations

import os
import pickle
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bstcad.designs import folder as folders
from bstcad.optics.surfaces.surfaces import Sphere
from bstcad.optics.trace.measure import Light
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load

ROOT = Path(__file__).parent.parent


def contents(folder):
    """Every file below a folder and its bytes."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def old(tmp_path):
    """An earlier design, with a file that a new one would not have."""
    folder = tmp_path / "outputs" / "thu"
    (folder / "figures").mkdir(parents=True)
    (folder / "lens.step").write_bytes(b"old step")
    (folder / "stale.png").write_bytes(b"old picture")
    (folder / "figures" / "flux.png").write_bytes(b"old figure")
    return folder


def write_new(building):
    (building / "lens.step").write_bytes(b"new step")
    (building / "figures").mkdir()
    (building / "figures" / "lens.png").write_bytes(b"new figure")


NEW = {"lens.step": b"new step", "figures/lens.png": b"new figure"}


class TestReplacing:
    def test_success_replaces_whole(self, old):
        with folders.replacing(old) as building:
            assert building.parent == old.parent and contents(old)["lens.step"] == b"old step"  # still there meanwhile
            write_new(building)
        assert contents(old) == NEW  # the stale files are gone
        assert list(old.parent.iterdir()) == [old]

    def test_a_new_folder_may_be_read_by_others_and_its_parents_are_made(self, tmp_path):
        folder = tmp_path / "a" / "b" / "thu"
        with folders.replacing(folder) as building:
            write_new(building)
        assert contents(folder) == NEW
        assert folder.stat().st_mode & 0o777 == 0o755
        assert [path.name for path in folder.parent.iterdir()] == ["thu"]

    @pytest.mark.parametrize("place", [None, "lens.stl"])
    def test_a_full_disk_names_the_folder_that_was_asked_for(self, old, place):
        """A writer says nothing of where, or names the place beside the folder, which is gone by then."""
        with pytest.raises(OSError, match="No space left") as full, folders.replacing(old) as building:
            raise OSError(28, "No space left on device", place and str(building / place))
        assert full.value.filename == str(old)

    @pytest.mark.parametrize("fault", [RuntimeError, KeyboardInterrupt, SystemExit])
    def test_a_fault_leaves_the_old_design_as_it_was_and_nothing_beside_it(self, old, fault):
        before = contents(old)
        for folder in (old, old.with_name("new")):
            with pytest.raises(fault), folders.replacing(folder) as building:
                write_new(building)
                raise fault("in the middle")
        assert contents(old) == before and list(old.parent.iterdir()) == [old]

    @pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
    def test_a_fault_between_the_two_renames_brings_the_old_design_back(self, old, monkeypatch, fault):
        def fails(*paths):
            raise fault

        before = contents(old)
        monkeypatch.setattr(folders, "_exchange", lambda one, other: False)  # a system that cannot do it in one step
        monkeypatch.setattr(os, "replace", fails)
        with pytest.raises(type(fault)), folders.replacing(old) as building:
            write_new(building)
        assert contents(old) == before and list(old.parent.iterdir()) == [old]

    def test_a_full_disk_is_noticed_before_the_old_design_moves(self, old, monkeypatch):
        def full(handle):
            raise OSError(28, "No space left on device")

        before = contents(old)
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"), folders.replacing(old) as building:
            write_new(building)
        assert contents(old) == before and list(old.parent.iterdir()) == [old]

    def test_the_working_folder_and_a_link_lead_to_the_design(self, old, tmp_path, monkeypatch):
        monkeypatch.chdir(old)
        link = tmp_path / "latest"
        link.symlink_to(old)
        for place in (Path("."), link):
            with folders.replacing(place) as building:
                write_new(building)
            assert contents(old) == NEW and list(old.parent.iterdir()) == [old] and link.is_symlink()


class TestReading:
    @pytest.fixture
    def folder(self, small_design, tmp_path):
        """scene.toml and design.npz of the small design, to be damaged."""
        for name in ("scene.toml", "design.npz"):
            shutil.copy(small_design.folder / name, tmp_path)
        return tmp_path

    @staticmethod
    def change(folder, **arrays):
        """Rewrite design.npz with some arrays replaced."""
        path = folder / "design.npz"
        with np.load(path) as data:
            kept = {name: data[name] for name in data.files}
        np.savez_compressed(path, **kept | arrays)

    def test_the_nominal_lens_is_the_designed_one(self, folder, small_scene):
        nominal = folders.read_nominal(folder)
        scene = nominal.scene
        assert scene == small_scene == load(folder / "scene.toml")
        with np.load(folder / "design.npz") as data:
            assert np.array_equal(nominal.lens.back.control_points(), data["control_points"])  # to the last bit
            assert np.array_equal(nominal.goals[0].picture, data["target"])
        assert nominal.lens.back.heights.dtype == torch.float64
        assert nominal.lens.front == scene.lens.front.surface and nominal.lens.outline == scene.lens.outline
        assert nominal.lens.index == scene.index and nominal.channels == scene.channels()
        screen = nominal.goals[0].screen
        assert (screen.x, screen.y, screen.shape) == ((-30.0, 30.0), (-25.0, 25.0), (48, 64))
        assert nominal.scene == scene

    DAMAGES = {
        "missing": lambda path: path.unlink(),
        "empty": lambda path: path.write_bytes(b""),
        "truncated": lambda path: path.write_bytes(path.read_bytes()[:-3000]),
        "a bare array": lambda path: np.save(path.open("wb"), np.zeros((33, 33, 3))),
        "pickle": lambda path: path.write_bytes(pickle.dumps({"control_points": 1})),
        "folder": lambda path: (path.unlink(), path.mkdir()),
    }

    NET = np.zeros((33, 33, 3))
    ARRAYS = {
        "pickled objects": {"control_points": np.array([{"a": 1}], dtype=object)},
        "net of another size": {"control_points": NET[:17, :17]},
        "net with NaN": {"control_points": NET * np.nan},
        "net of words": {"control_points": NET.astype(str)},
        "target of another size": {"target": np.ones((32, 32)) / 1024},
        "target with NaN": {"target": np.full((48, 64), np.nan)},
        "curvature NaN": {"front_curvature": np.nan},
        "two curvatures": {"front_curvature": np.zeros(2)},
    }

    @pytest.mark.parametrize("damage", [*DAMAGES, *ARRAYS])
    def test_what_is_no_design_is_one_sentence(self, folder, damage):
        if damage in self.DAMAGES:
            self.DAMAGES[damage](folder / "design.npz")
        else:
            self.change(folder, **self.ARRAYS[damage])
        with pytest.raises(SceneError, match=r"design\.npz: .*generate the design again") as caught:
            folders.read_nominal(folder)
        assert "\n" not in str(caught.value)

    def test_a_missing_array_is_named(self, folder):
        path = folder / "design.npz"
        with np.load(path) as data:
            np.savez_compressed(path, **{key: data[key] for key in data.files if key != "control_points"})
        with pytest.raises(SceneError, match="control_points"):
            folders.read_nominal(folder)


def test_what_is_written_is_what_is_read(small_design, small_scene, tmp_path):
    """design.npz of another lens: its own net and curvature come back to the last bit."""
    nominal = folders.read_nominal(small_design.folder)
    scene = nominal.scene
    g = torch.Generator().manual_seed(1)
    back = replace(nominal.lens.back, heights=torch.randn(33, 33, generator=g, dtype=torch.float64))
    lens = nominal.lens.with_back(back).with_front(Sphere(15.0, -0.0123456789))
    design = folders.DesignedLens(scene, lens, nominal.goals)
    (tmp_path / "scene.toml").write_text(scene.toml())
    light = Light(nominal.goals[0].picture * 2, rrmsd=0.1, standard_error=0.01, rays=64, flux={}, picture_error=0.02)
    folders.write_design(design, [light], tmp_path)
    again = folders.read_nominal(tmp_path).lens
    assert np.array_equal(again.back.control_points(), lens.back.control_points())
    assert again.front == lens.front
    with zipfile.ZipFile(tmp_path / "design.npz") as archive:
        assert archive.testzip() is None
