"""A damaged cache of kernels is a cache miss: the kernel is compiled again, its result is right, its cache is whole."""

from __future__ import annotations

import errno
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from bstcad.runs import kernel_cache


def twice(x):
    return 2 * x


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def kernel():
    """Return the kernel as a new process would make it, after a first call."""
    made = kernel_cache.compiled_kernel()(twice)
    assert made(2) == 4
    return made


def hits(made):
    return sum(made.stats.cache_hits.values())


def files(place, ending):
    return [path for path in place.rglob(f"*.{ending}") if path.is_file()]


def emptied(path: Path):
    path.write_bytes(b"")


def cut(path: Path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def overwritten(path: Path):
    path.write_bytes(b"\x80" + bytes(path.stat().st_size - 1))


def one_bit_changed(path: Path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4  # in machine code, where the file can be read as before
    path.write_bytes(content)


def unreadable(path: Path):
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("damage", [emptied, cut, overwritten, one_bit_changed, Path.unlink, unreadable])
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damage_is_a_miss_and_is_repaired(place, damage, ending):
    assert hits(kernel()) == 0 and hits(kernel()) == 1
    [path] = files(place, ending)
    damage(path)
    assert hits(kernel()) == 0
    if damage is not unreadable:  # a folder stays
        assert hits(kernel()) == 1


def test_two_processes_that_compile_at_once_do_not_mix_their_forms(place, monkeypatch):
    gaps, none = np.arange(6.0)[::2], np.arange(3.0)  # an array whose numbers are not neighbours in memory, and another
    first, second = (kernel_cache.compiled_kernel()(twice) for _ in range(2))
    save_data = IndexDataCacheFile._save_data

    def save_later(self, name, data):
        """Save a form after the second process, which read the index when it was empty, has saved its own."""
        monkeypatch.setattr(IndexDataCacheFile, "_save_data", save_data)
        with monkeypatch.context() as before:
            before.setattr(kernel_cache._CheckedFiles, "_load_index", lambda self: {})
            second(gaps)
        save_data(self, name, data)

    monkeypatch.setattr(IndexDataCacheFile, "_save_data", save_later)
    first(none)
    for numbers in (gaps, none):
        assert kernel_cache.compiled_kernel()(twice)(numbers).tolist() == (2 * numbers).tolist()


def test_a_full_disk_keeps_nothing_and_stops_nothing(place, monkeypatch):
    def full(self, path):
        raise OSError(errno.ENOSPC, "No space left on device", path)

    monkeypatch.setattr(IndexDataCacheFile, "_open_for_write", full)
    assert hits(kernel()) == hits(kernel()) == 0 and not files(place, "nb?")


def test_without_a_folder_to_write_kernels_are_compiled(monkeypatch):
    monkeypatch.setattr(kernel_cache.CheckedCache._impl_class, "_locator_classes", [])
    assert hits(kernel()) == 0
