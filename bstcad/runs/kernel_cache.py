"""Cache of compiled kernels on disk, in which damage of any kind is a cache miss.

numba trusts the files of its cache: an empty or truncated file and a full disk raise errors, and a changed byte of
machine code may end the process.  So each file ends with the SHA-256 of its content, and a kernel is compiled again
if its files cannot be read, written or trusted.

numba numbers the compiled forms of a function.  Two processes that compile it at the same time for other types of
arguments give both forms one number, and the form that is saved last is then called for both: an array with gaps is
read as one without.  So the file of a form is named after its types.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

DIGEST_SIZE = 32  # length of the SHA-256 at the end of a file (bytes)


def compiled_kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator numba.njit(nogil=True, …) for a kernel whose compiled forms are kept in a checked cache."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(nogil=True, **options)(function)
        kernel._cache = _cache_of(function)
        return kernel

    return decorate


def _cache_of(function: Callable[..., Any]) -> Any:
    """Return the cache of a function; one that keeps nothing if no folder for it can be written."""
    try:
        return CheckedCache(function)
    except (RuntimeError, OSError):  # numba raises RuntimeError if it finds no writable folder
        return NullCache()


class CheckedCache(FunctionCache):  # type: ignore[misc]
    """Cache of the compiled forms of a function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _CheckedFiles(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled form for a signature; None if the cache does not have it, or is damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # pickle, LLVM and the system raise errors of their own
            with contextlib.suppress(OSError):
                self.flush()  # so that the next form can be saved
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled form for a signature, if the system permits."""
        with contextlib.suppress(Exception):
            super().save_overload(sig, data)


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """Index of a function and its compiled forms, each in a file that ends with its SHA-256, which numba ignores."""

    def save(self, key: Any, data: Any) -> None:
        """Save a compiled form, before the index that has its key."""
        self._save_data(self._data_name(key), data)
        found = self._load_index()
        if key not in found:
            self._save_index({**found, key: self._data_name(key)})

    def load(self, key: Any) -> Any:
        """Return the compiled form of a key; None if there is none."""
        if key not in self._load_index():
            return None
        with contextlib.suppress(OSError):
            return self._load_data(self._data_name(key))
        return None

    def _data_name(self, key: Any) -> str:
        """Return the name of a form's file.  key: types of the arguments, processor, digest of the function."""
        return f"{Path(self._index_name).stem}.{sha256(repr(key).encode()).hexdigest()[:16]}.nbc"

    def _load_index(self) -> Any:
        _check(Path(self._index_path))
        return super()._load_index()

    def _load_data(self, name: str) -> Any:
        _check(Path(self._data_path(name)))
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + sha256(content.getvalue()).digest())


def _check(path: Path) -> None:
    """Raise ValueError if a file does not end with the SHA-256 of its content; numba looks for missing files itself."""
    if path.exists():
        content = path.read_bytes()
        if content[-DIGEST_SIZE:] != sha256(content[:-DIGEST_SIZE]).digest():
            raise ValueError(f"{path}: is damaged; delete it")
