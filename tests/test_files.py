"""What is read is bounded, and what is written stays where it is."""

from __future__ import annotations

import os

import numpy as np
import pytest

from bstcad import files


def test_a_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"12345")
    assert files.contents(path, 5) == b"12345"
    with pytest.raises(ValueError, match="it holds over"):
        files.contents(path, 4)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: None, "No such file"),
        (lambda path: path.mkdir(), "it is a folder"),
        (os.mkfifo, "it is a pipe or a device"),
        (lambda path: path.symlink_to("/dev/zero"), "it is a pipe or a device"),
    ],
    ids=["nothing", "folder", "pipe", "device"],
)
def test_what_is_no_file_is_not_opened(tmp_path, make, reason):
    make(tmp_path / "x")
    with pytest.raises(ValueError, match=reason):
        files.contents(tmp_path / "x", 5)


def test_a_file_takes_the_place_of_what_stood_there(tmp_path):
    path, other = tmp_path / "x", tmp_path / "other"
    other.write_bytes(b"other")
    path.symlink_to(other)
    files.put(path, b"new")
    assert path.read_bytes() == b"new" and not path.is_symlink() and other.read_bytes() == b"other"
    files.put(path, b"newer")
    assert path.read_bytes() == b"newer" and sorted(tmp_path.iterdir()) == [other, path]


def test_a_folder_takes_the_place_of_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "x").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    for _ in range(2):
        assert files.folder_in_place(tmp_path / "x").is_dir() and not (tmp_path / "x").is_symlink()


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int32, ">f8"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_as_numbers(tmp_path, kind, save):
    wanted = np.arange(12.0).reshape(3, 4)
    save(tmp_path / "x.npz", net=wanted.astype(kind), flat=np.asfortranarray(wanted), one=2.5, more=np.zeros(5))
    found = files.arrays(tmp_path / "x.npz", {"net": (3, 4), "flat": (3, 4), "one": ()}, 10_000)
    assert np.array_equal(found["net"], wanted) and np.array_equal(found["flat"], wanted) and found["one"] == 2.5
    assert all(array.dtype == np.float64 for array in found.values()) and set(found) == {"net", "flat", "one"}
