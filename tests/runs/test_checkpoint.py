"""A checkpoint is whole or not there, and says so when it is not what it was asked for."""

from __future__ import annotations

import hashlib
import io
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from bstcad.runs import checkpoint
from bstcad.runs.checkpoint import CheckpointError, Keeper

PURPOSE = {"version": "1", "tailoring": {"rays": 512}}
STATE = {
    "name": "stage 2",
    "numbers": (1, 0.1, math.inf, None, True),
    "single": np.linspace(0, 1, 7, dtype=np.float32),
    "pairs": ((torch.eye(3, dtype=torch.float64), 1e-300), (torch.zeros(0), -0.0)),
    "inner": {"whole": np.arange(4)},
}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / ".thu.checkpoint"
    checkpoint.write(path, PURPOSE, STATE)
    return path


def same(one, other):
    """Equal to the bit, kinds included."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return isinstance(other, torch.Tensor) and same(one.numpy(), other.numpy())
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return type(one) is type(other) and repr(one) == repr(other)


def test_what_is_read_is_what_was_written(path):
    purpose, state = checkpoint.read(path)
    assert same(purpose, PURPOSE) and same(state, STATE)


def test_any_changed_byte_is_noticed(path):
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(CheckpointError, match="start without --resume"):
            checkpoint.read(path)


def test_any_truncation_is_noticed(path):
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(CheckpointError, match="start without --resume"):
            checkpoint.read(path)


@pytest.mark.parametrize("packed", ["objects", "compressed", "no tree", "no zip"])
def test_a_checksum_alone_makes_no_checkpoint(path, packed):
    body = io.BytesIO()
    if packed == "objects":  # which numpy would unpickle if it were let
        np.savez(body, tree=np.array([print], dtype=object))
    elif packed == "compressed":  # a megabyte that could be a terabyte
        np.savez_compressed(body, tree=np.zeros(1_000_000, dtype=np.uint8))
    elif packed == "no tree":
        np.savez(body, other=np.zeros(3))
    digest = hashlib.sha256(body.getvalue()).hexdigest().encode()
    path.write_bytes(checkpoint.MAGIC + digest + b"\n" + body.getvalue())
    with pytest.raises(CheckpointError, match="no checkpoint of bstcad's"):
        checkpoint.read(path)


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_fault_while_writing_leaves_the_one_before(path, monkeypatch, step, fault):
    def fails(*arguments):
        raise fault

    before = path.read_bytes()
    monkeypatch.setattr(os, step, fails)
    with pytest.raises(type(fault)):
        checkpoint.write(path, PURPOSE, {"name": "later"})
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]


class TestKeeper:
    def test_writes_no_more_often_than_it_should(self, tmp_path, monkeypatch):
        now, written = [0.0], []
        monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])

        def slow(path, purpose, state):  # a second each: two in a hundred leave one in fifty seconds
            written.append(state["step"])
            path.touch()
            now[0] += 1.0

        monkeypatch.setattr(checkpoint, "write", slow)
        keeper = Keeper(tmp_path / "c", PURPOSE)
        for step in range(200):
            now[0] = max(now[0], float(step))
            keeper({"step": step})
        assert written == [10, 61, 112, 163]
        assert keeper.flush() and written[-1] == 199 and keeper.flush() and len(written) == 5

    def test_a_full_disk_is_said_and_the_design_goes_on(self, tmp_path, monkeypatch):
        def full(*arguments):
            raise OSError(28, "No space left on device")

        said = []
        monkeypatch.setattr(checkpoint, "write", full)
        keeper = Keeper(tmp_path / "c", PURPOSE, said.append, every=0.0)
        keeper({"step": 1})
        assert len(said) == 1 and "No space left on device" in said[0] and "goes on" in said[0]
        assert not keeper.flush()

    def test_what_is_gone_is_written_again_or_not_said_to_be_kept(self, tmp_path):
        folder = tmp_path / "outputs"
        folder.mkdir()
        keeper = Keeper(folder / ".thu.checkpoint", PURPOSE)
        keeper({"step": 1})
        assert keeper.flush()
        keeper.path.unlink()
        assert keeper.flush() and keeper.path.exists()
        keeper.path.unlink()
        folder.rmdir()
        assert not keeper.flush()

    def test_at_the_end_a_state_finds_another_place(self, tmp_path, monkeypatch, path):
        monkeypatch.setattr(checkpoint.tempfile, "tempdir", str(tmp_path))
        keeper = Keeper(tmp_path / "gone" / ".thu.checkpoint", PURPOSE, pytest.fail)
        assert keeper.kept() == ""  # nothing was found yet
        keeper.latest = STATE
        said = keeper.kept()
        refuge = next(tmp_path.glob("bstcad-*")) / "thu.checkpoint"
        assert said == (
            f"what was found so far is kept in {refuge}; move it to {keeper.path} and --resume goes on from there"
        )
        assert same(checkpoint.read(refuge)[1], STATE)
        here = Keeper(path, PURPOSE)
        here.found()
        assert here.kept() == "what was found so far is kept; the same command with --resume goes on from there"

    def test_no_room_anywhere_is_said_and_leaves_nothing(self, tmp_path, monkeypatch):
        def full(*arguments):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(checkpoint.tempfile, "tempdir", str(tmp_path))
        monkeypatch.setattr(os, "fsync", full)
        keeper = Keeper(tmp_path / ".thu.checkpoint", PURPOSE, latest=STATE)
        assert keeper.kept().startswith("there was no room for what was found so far")
        assert list(tmp_path.iterdir()) == []

    def test_finds_its_own(self, path):
        assert same(Keeper(path, PURPOSE).found(), STATE)
        assert Keeper(path.with_name("none"), PURPOSE).found() is None

    def test_refuses_that_of_another_design_by_name(self, path):
        with pytest.raises(CheckpointError, match=r"another design \(tailoring\.rays was 512, now it is 768\)"):
            Keeper(path, {**PURPOSE, "tailoring": {"rays": 768}}).found()

    def test_a_refused_scene_takes_only_its_own_checkpoint_with_it(self, path):
        keeper = Keeper(path, {"another": "scene"})
        keeper({"step": 1})  # not written yet
        keeper.withdraw()
        assert same(checkpoint.read(path)[1], STATE) and not keeper.flush()
        keeper({"step": 2})
        assert keeper.flush()
        keeper.withdraw()
        assert not path.exists()

    def test_what_a_run_goes_on_from_is_there_to_go_on_from_again(self, path):
        keeper = Keeper(path, PURPOSE)
        keeper.found()
        assert keeper.flush() and same(checkpoint.read(path)[1], STATE)

    def test_a_pipe_is_no_checkpoint(self, tmp_path):
        os.mkfifo(tmp_path / "c")
        with pytest.raises(CheckpointError, match="it is a pipe"):
            checkpoint.read(tmp_path / "c")

    def test_leaves_nothing_behind_a_finished_design(self, path):
        keeper = Keeper(path, PURPOSE)
        keeper.remove()
        keeper.remove()
        assert list(path.parent.iterdir()) == []


@dataclass(frozen=True)
class Point:
    x: float
    net: torch.Tensor


@dataclass(frozen=True)
class Line:
    start: Point
    name: str
    through: tuple[tuple[float, int], ...]
    end: Point | Plane | None
    more: Mapping[str, float | torch.Tensor]


@dataclass(frozen=True)
class Plane:
    z: float


NET = torch.eye(3, dtype=torch.float64)
LINE = Line(Point(1.5, NET), "a", ((0.5, 1), (2.0, 3)), Plane(3.0), {"tilt": NET, "z": 1.0})


def test_records_go_there_and_back(path):
    checkpoint.write(path, PURPOSE, LINE)
    purpose, line = checkpoint.read(path, Line)
    assert same(purpose, PURPOSE) and isinstance(line.end, Plane)
    assert same(checkpoint.as_tree(line), checkpoint.as_tree(LINE))


@pytest.mark.parametrize(
    "other",
    [
        LINE.start,
        replace(LINE, name=3),
        replace(LINE, start=Plane(0.0)),
        replace(LINE, start=replace(LINE.start, net=NET.numpy())),
        replace(LINE, through=((0.5, 1), (2.0,))),
        replace(LINE, end="far"),
        replace(LINE, more={"z": None}),
    ],
    ids=["another record", "a number", "in a field", "an array", "too short", "none of them", "in a mapping"],
)
def test_what_is_not_of_the_kind_is_no_checkpoint(path, other):
    checkpoint.write(path, PURPOSE, other)
    with pytest.raises(CheckpointError, match="no checkpoint of bstcad's"):
        checkpoint.read(path, Line)


def test_on_a_device_all_tensors_of_a_record_are():
    line = checkpoint.on_device(LINE, "meta")
    assert line.start.net.device.type == line.more["tilt"].device.type == "meta" and line.through == LINE.through
