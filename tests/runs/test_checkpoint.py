"""A checkpoint is whole or not there, and tells itself apart from others."""

from __future__ import annotations

import hashlib
import io
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from bstcad.runs import checkpoint
from bstcad.runs.checkpoint import Keeper
from bstcad.runs.files import SceneError

PURPOSE = {"version": "1", "tailoring": {"rays": 512}}
STATE = {
    "name": "stage 2",
    "numbers": (1, 0.1, math.inf, None, True),
    "single": np.linspace(0, 1, 7, dtype=np.float32),
    "pairs": ((torch.eye(3, dtype=torch.float64), 1e-300), (torch.zeros(0), -0.0)),
    "inner": {"whole": np.arange(4)},
}


@dataclass(frozen=True)
class Plane:
    z: float


@dataclass(frozen=True)
class Line:
    start: Plane
    through: tuple[tuple[float, int], ...]
    end: Sphere | Plane | None
    more: Mapping[str, float | torch.Tensor]


@dataclass(frozen=True)
class Sphere:
    z: float
    net: torch.Tensor


NET = torch.eye(3, dtype=torch.float64)
LINE = Line(Plane(1.5), ((0.5, 1), (2.0, 3)), Sphere(3.0, NET), {"tilt": NET, "z": 1.0})


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
    return type(one) is type(other) and (repr(one) == repr(other) or same(vars(one), vars(other)))


class TestFile:
    def test_what_is_read_is_what_was_written_on_the_device_that_is_asked_for(self, path):
        for state in (STATE, LINE):
            checkpoint.write(path, PURPOSE, state)
            purpose, again = checkpoint.read(path, type(state))
            assert same(purpose, PURPOSE) and same(again, state)
        line = checkpoint.read(path, Line, "meta")[1]
        assert line.end.net.device.type == line.more["tilt"].device.type == "meta" and line.through == LINE.through

    def test_any_changed_byte_and_any_truncation_is_noticed(self, path):
        whole = path.read_bytes()
        changed = (whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :] for k in range(len(whole)))
        for damaged in (*changed, *(whole[:length] for length in range(len(whole)))):
            path.write_bytes(damaged)
            with pytest.raises(SceneError, match="start without --resume"):
                checkpoint.read(path, dict)
        path.write_bytes(whole.replace(checkpoint.MAGIC, b"bstcad checkpoint 3\n"))
        with pytest.raises(SceneError, match="'bstcad checkpoint 3'"):
            checkpoint.read(path, dict)

    @pytest.mark.parametrize("packed", ["objects", "compressed", "no zip"])
    def test_a_checksum_alone_makes_no_checkpoint(self, path, packed):
        body = io.BytesIO()
        if packed == "objects":  # which numpy would unpickle if it were let
            np.savez(body, tree=np.array([print], dtype=object))
        elif packed == "compressed":  # a megabyte that could be a terabyte
            np.savez_compressed(body, tree=np.zeros(1_000_000, dtype=np.uint8))
        digest = hashlib.sha256(body.getvalue()).hexdigest().encode()
        path.write_bytes(checkpoint.MAGIC + digest + b"\n" + body.getvalue())
        with pytest.raises(SceneError, match="without --resume"):
            checkpoint.read(path, dict)

    def test_what_is_not_of_the_kind_is_no_checkpoint(self, path):
        for other in (LINE.start, STATE):
            checkpoint.write(path, PURPOSE, other)
            with pytest.raises(SceneError, match="without --resume"):
                checkpoint.read(path, Line)

    @pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
    @pytest.mark.parametrize("step", ["fsync", "replace"])
    def test_a_fault_while_writing_leaves_the_one_before(self, path, monkeypatch, step, fault):
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

    def test_at_the_end_a_state_finds_another_place(self, tmp_path, monkeypatch, path):
        monkeypatch.setattr(checkpoint.tempfile, "tempdir", str(tmp_path))
        keeper = Keeper(tmp_path / "gone" / ".thu.checkpoint", PURPOSE, pytest.fail)
        assert keeper.keep_at_exit() == ""  # there is no state yet
        keeper.latest = STATE
        said, refuge = keeper.keep_at_exit(), next(tmp_path.glob("bstcad-*")) / "thu.checkpoint"
        assert said == (
            f"the design so far is kept in {refuge}; move it to {keeper.path} and use --resume to continue it"
        )
        assert same(checkpoint.read(refuge, dict)[1], STATE)
        here = Keeper(path, PURPOSE)
        here.load()
        assert here.keep_at_exit() == "the design so far is kept; run the same command with --resume to continue it"

    def test_a_full_disk_is_said_and_the_design_goes_on_and_leaves_nothing(self, tmp_path, monkeypatch):
        def full(*arguments):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(checkpoint.tempfile, "tempdir", str(tmp_path))
        monkeypatch.setattr(os, "fsync", full)
        said = []
        keeper = Keeper(tmp_path / ".thu.checkpoint", PURPOSE, said.append, interval=0.0)
        keeper(STATE)
        assert len(said) == 1 and "No space left on device" in said[0] and "continues" in said[0]
        assert not keeper.flush() and keeper.keep_at_exit().startswith("the design so far is lost")
        assert list(tmp_path.iterdir()) == []

    def test_finds_its_own_to_go_on_from_it_again_and_no_other(self, path):
        keeper = Keeper(path, PURPOSE)
        assert same(keeper.load(), STATE) and keeper.flush() and same(checkpoint.read(path, dict)[1], STATE)
        assert Keeper(path.with_name("none"), PURPOSE).load() is None
        with pytest.raises(SceneError, match=r"another design \(tailoring\.rays was 512, now it is 768\)"):
            Keeper(path, {**PURPOSE, "tailoring": {"rays": 768}}).load()
        os.mkfifo(path.with_name("pipe"))
        with pytest.raises(SceneError, match="it is a pipe"):
            Keeper(path.with_name("pipe"), PURPOSE).load()

    def test_a_refused_scene_takes_only_its_own_checkpoint_with_it(self, path):
        keeper = Keeper(path, {"another": "scene"})
        keeper({"step": 1})  # not written yet
        keeper.withdraw()
        assert same(checkpoint.read(path, dict)[1], STATE) and not keeper.flush()
        keeper({"step": 2})
        assert keeper.flush()
        for _ in range(2):
            keeper.withdraw()
            assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize("array", [np.array([0.0, math.nan]), torch.tensor([math.inf], dtype=torch.float64)])
def test_a_state_with_a_number_that_is_not_finite_is_refused(path, array):
    checkpoint.write(path, PURPOSE, {**STATE, "single": array})
    with pytest.raises(SceneError, match="is not a checkpoint of bstcad"):
        checkpoint.read(path, dict)
