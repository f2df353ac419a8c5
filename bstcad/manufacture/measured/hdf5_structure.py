"""Check the structure of an HDF5 file (Zygo DATX) before its data are read.

The data of an HDF5 file may be in other files, in the views of virtual datasets, or behind links, and a short file may
declare any number of values.  A height map needs none of this.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from typing import Any

from bstcad.manufacture.measured.point_text import NotAMap

MAX_OBJECTS = 10_000  # largest number of links, attributes and rows of metadata of a file each; gauges write hundreds
MAX_METADATA_SIZE = 10_000_000  # largest size (bytes) of the table of metadata, and of an attribute
MAX_CHUNK_SIZE = 160_000_000  # largest size (bytes) of a chunk, which HDF5 unpacks as a whole: 20 million heights
FIRST_PLUGIN_FILTER = 256  # smallest number of a filter that is not part of HDF5 itself (H5Z_FILTER_RESERVED)
METADATA, ROOT = "MetaData", b"Root"  # name of the table of metadata, and of its outermost entry
MAX_NAME = 60  # largest length (characters) of a name in a sentence
HINT = "export the file again with the program of the gauge"


def check_structure(data: bytes) -> None:
    """Raise NotAMap, with a sentence, if an HDF5 file has a structure that a height map does not need."""
    import h5py

    with h5py.File(io.BytesIO(data), "r") as file:
        for found in _objects(file.id):
            _check_attributes(found)
            if isinstance(found, h5py.h5d.DatasetID):
                _check_storage(found)
        if METADATA in file:
            _check_metadata(file[METADATA])


def _objects(root: Any) -> Iterator[Any]:
    """Yield the identifiers of the objects of a file, each once; raise NotAMap for links other than within it."""
    from h5py import h5g, h5l, h5o

    waiting, known, links = [h5g.open(root, b"/")], set(), 0
    while waiting:
        found = waiting.pop()
        if (address := h5o.get_info(found).addr) in known:
            continue
        known.add(address)
        yield found
        if not isinstance(found, h5g.GroupID):
            continue
        links += found.get_num_objs()
        if links > MAX_OBJECTS:
            raise NotAMap(f"contains more than {MAX_OBJECTS} links; {HINT}")
        for name in (found.get_objname_by_idx(index) for index in range(found.get_num_objs())):
            if found.links.get_info(name).type != h5l.TYPE_HARD:
                raise NotAMap(f"contains the link {_quoted(name)} to another place or file; {HINT}")
            waiting.append(h5o.open(found, name))


def _check_attributes(found: Any) -> None:
    """Raise NotAMap if an object has too many attributes or too large ones."""
    from h5py import h5a

    count = h5a.get_num_attrs(found)
    if count > MAX_OBJECTS:
        raise NotAMap(f"contains {count} attributes of one object, and {MAX_OBJECTS} are possible; {HINT}")
    for index in range(count):
        attribute = h5a.open(found, index=index)
        _check_size(f"attribute {_quoted(attribute.name)}", attribute)


def _check_size(words: str, found: Any) -> None:
    """Raise NotAMap if an attribute or a dataset of metadata declares too many bytes; words: its name."""
    size = math.prod(found.shape) * found.get_type().get_size()
    if size > MAX_METADATA_SIZE:
        raise NotAMap(f"declares {size} bytes in its {words}, and {MAX_METADATA_SIZE} are possible; {HINT}")


def _check_storage(dataset: Any) -> None:
    """Raise NotAMap if a dataset is stored outside the file, in huge chunks, or by a filter of a plugin."""
    from h5py import h5d, h5i

    properties, name = dataset.get_create_plist(), _quoted(h5i.get_name(dataset))
    if properties.get_external_count() or properties.get_layout() == h5d.VIRTUAL:
        raise NotAMap(f"contains the dataset {name}, whose data are in another place or file; {HINT}")
    if properties.get_layout() == h5d.CHUNKED:
        size = math.prod(properties.get_chunk()) * dataset.get_type().get_size()
        if size > MAX_CHUNK_SIZE:
            raise NotAMap(
                f"contains the dataset {name} in chunks of {size} bytes, and {MAX_CHUNK_SIZE} are possible; {HINT}"
            )
    for number in (properties.get_filter(index)[0] for index in range(properties.get_nfilters())):
        if number >= FIRST_PLUGIN_FILTER:
            raise NotAMap(f"contains the dataset {name}, which needs the plugin {number} of HDF5; {HINT}")


def _check_metadata(table: Any) -> None:
    """Raise NotAMap if the table has too many rows, or too many entries once its references are replaced.

    A row is a context, a key, and a value or the reference to another context, in braces.  Contexts that refer twice to
    the next one double the number of entries with each row, and contexts in a circle have no end.
    """
    if table.size > MAX_OBJECTS:
        raise NotAMap(f"declares {table.size} rows of metadata, and {MAX_OBJECTS} are possible; {HINT}")
    _check_size("table of metadata", table.id)
    contexts: dict[bytes, dict[bytes, bytes]] = {}
    for context, key, value in table:
        contexts.setdefault(context, {})[key] = value
    waiting, entries = [ROOT], 0
    while waiting:
        values = contexts.get(waiting.pop(), {}).values()
        entries += len(values)
        if entries > MAX_OBJECTS:
            raise NotAMap(f"has metadata of more than {MAX_OBJECTS} entries, counted where they recur; {HINT}")
        waiting += [value for value in values if value.startswith(b"{") and value.endswith(b"}")]


def _quoted(name: str | bytes | None) -> str:
    """Return a name of a file for a sentence."""
    text = name.decode(errors="replace") if isinstance(name, bytes) else name or ""
    return repr(text if len(text) <= MAX_NAME else f"{text[: MAX_NAME - 1]}…")
