"""A kernel is compiled anew when any file of the kernels has changed."""

from pathlib import Path

import numba
import pytest

from bstcad.optics.kernels import compiling


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "FOLDER", tmp_path)
    (tmp_path / "a.py").write_text("one")
    (tmp_path / "b.py").write_text("two")
    yield tmp_path
    compiling._caches.cache_clear()


def caches(chosen=""):
    compiling._caches.cache_clear()
    return compiling._caches(chosen)


def test_the_place_of_the_caches_follows_every_file(files):
    before = caches()
    assert before.parent == files / "__pycache__" and caches() == before
    before.mkdir(parents=True)
    (files / "b.py").write_text("another two")
    after = caches()
    assert after != before and not before.exists()  # nobody will ask for those again


def test_a_chosen_place_counts_and_nothing_there_is_removed(files, tmp_path):
    kept = tmp_path / "chosen" / f"{compiling.PREFIX}of-another-version"
    kept.mkdir(parents=True)
    assert caches(str(kept.parent)).parent == kept.parent and kept.exists()


def test_a_kernel_keeps_its_code_there():
    """And other users of numba in this process keep theirs where they had it."""
    before = numba.config.CACHE_DIR

    def twice(x):
        return 2 * x

    kernel = compiling.compiled()(twice)
    assert kernel(2) == 4 and before == numba.config.CACHE_DIR
    assert Path(kernel.stats.cache_path).is_relative_to(compiling._caches(before))
