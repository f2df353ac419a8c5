"""Reading is bounded, writing stays in its folder, and one run at a time works in a folder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bstcad.runs import files
from bstcad.runs.files import SceneError

ROOT = Path(__file__).parent.parent.parent


def test_a_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"12345")
    assert files.contents(path, 5) == b"12345"
    with pytest.raises(ValueError, match="it is larger than"):
        files.contents(path, 4)


@pytest.mark.parametrize(("make", "reason"), [
    (lambda path: None, "No such file"),
    (lambda path: path.mkdir(), "it is a folder"),
    (os.mkfifo, "it is a pipe or a device"),
    (lambda path: path.symlink_to("/dev/zero"), "it is a pipe or a device"),
], ids=["nothing", "folder", "pipe", "device"])  # fmt: skip
def test_what_is_no_file_is_not_opened(tmp_path, make, reason):
    make(tmp_path / "x")
    with pytest.raises(ValueError, match=reason):
        files.contents(tmp_path / "x", 5)


def test_files_and_folders_take_the_place_of_links(tmp_path):
    path, other = tmp_path / "x", tmp_path / "other"
    other.write_bytes(b"other")
    path.symlink_to(other)
    files.put(path, b"new")
    assert path.read_bytes() == b"new" and not path.is_symlink() and other.read_bytes() == b"other"
    files.put(path, b"newer")
    assert path.read_bytes() == b"newer" and sorted(tmp_path.iterdir()) == [other, path]
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "y").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    for _ in range(2):
        assert files.folder_in_place(tmp_path / "y").is_dir() and not (tmp_path / "y").is_symlink()


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int32, ">f8"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_as_numbers(tmp_path, kind, save):
    wanted = np.arange(12.0).reshape(3, 4)
    save(tmp_path / "x.npz", net=wanted.astype(kind), flat=np.asfortranarray(wanted), one=2.5, more=np.zeros(5))
    found = files.arrays(tmp_path / "x.npz", {"net": (3, 4), "flat": (3, 4), "one": ()}, 10_000)
    assert np.array_equal(found["net"], wanted) and np.array_equal(found["flat"], wanted) and found["one"] == 2.5
    assert all(array.dtype == np.float64 for array in found.values()) and set(found) == {"net", "flat", "one"}
    assert files.names(tmp_path / "x.npz") == ["net", "flat", "one", "more"] and files.names(tmp_path / "none") == []


def test_names_that_the_system_does_not_permit_are_refused_by_their_length(tmp_path):
    files.check_free(tmp_path / ("x" * 230))
    for length in (231, 250, 300):
        with pytest.raises(files.SceneError, match=f"has {length} bytes, and 230 is the maximum; give a shorter name"):
            files.check_free(tmp_path / ("x" * length))
    with pytest.raises(OSError) as caught:
        (tmp_path / ("x" * 300)).write_bytes(b"")
    assert files.sentence_of(caught.value).endswith("on this system; give a shorter name")


def test_every_damage_of_an_archive_is_a_value_error(tmp_path):
    path, rng = tmp_path / "x.npz", np.random.default_rng(1)
    np.savez_compressed(path, control_points=rng.normal(size=(9, 9, 3)), flat=np.zeros((3, 4)))
    whole, refused = path.read_bytes(), 0
    for _ in range(300):
        content = bytearray(whole[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.3 else whole)
        for place in rng.integers(0, len(content), 4):
            content[place] = rng.integers(256)
        path.write_bytes(content)
        for read in (lambda: files.net(path, 100), lambda: files.arrays(path, {"flat": (3, 4)}, 10_000)):
            try:
                read()
            except ValueError:
                refused += 1
        assert isinstance(files.names(path), list)
    assert refused > 300  # the others have changed bytes that the checksums of the archive do not cover


# --- one run at a time ------------------------------------------------------------------------------------------------


@pytest.fixture
def other(tmp_path):
    """Another process that holds the lock of tmp_path / "lens"."""
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom bstcad.runs import files\n"
        "with files.exclusive(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "lens")]
    running = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert running.stdout.readline() == "held\n"
    yield running
    running.kill()
    running.communicate()


def test_a_second_run_is_one_sentence_and_a_killed_one_locks_nothing(tmp_path, other):
    lens, sentence = tmp_path / "lens", rf"lens: is in use by another run \(process {other.pid}\); .* -o"
    with pytest.raises(SceneError, match=sentence), files.exclusive(lens):
        pass
    with files.exclusive(tmp_path / "another"):
        pass
    other.kill()
    other.wait()
    assert files.beside(lens, "lock").exists()
    with files.exclusive(lens):
        assert files.beside(lens, "lock").read_text() == str(os.getpid())
    assert list(tmp_path.iterdir()) == []


def test_a_link_leads_to_the_lock_of_the_folder_itself_also_on_a_full_disk(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with files.exclusive(tmp_path / "real"), pytest.raises(SceneError, match="unknown process"):  # noqa: SIM117
        with files.exclusive(tmp_path / "link"):
            pass
