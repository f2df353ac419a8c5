"""The folders that the workbench works in: scene files with what is not saved yet, pictures, and finished designs.

A scene is called by the stem of its file, a design by its folder's name; no path goes to the page.  The text of a scene
that is being edited lies in a hidden file beside the scene file, so that neither a closed page nor a killed server
loses a change; `save` puts it into the scene file, unless another program wrote that meanwhile.
"""

from __future__ import annotations

import codecs
import contextlib
import hashlib
import os
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bstcad.app.scene_text import changed, tables
from bstcad.runs import files
from bstcad.runs.files import SentenceError
from bstcad.scene import new_scene, picture, scene_file
from bstcad.scene import scene as scenes
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene
from bstcad.scene.schema import contents

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")  # of a scene or a design: no path, no hidden file
PICTURES = "pictures"  # the folder of uploads, beside the scenes
UNSAVED = "unsaved"  # kind of the hidden file
LARGEST_UPLOAD = 100_000_000  # bytes
DESIGN = ("report.json", "design.npz")  # files of which one tells a design's folder


@dataclass(frozen=True)
class Opened:
    """A scene as it is being edited."""

    name: str
    text: str
    saved: bool  # does the scene file hold this text?

    @property
    def revision(self) -> str:
        """A name for this very text."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:16]


class Workspace:
    """The folder of the scene files and the folder of the designs; one thread at a time changes a scene."""

    def __init__(self, scene_folder: Path, designs: Path) -> None:
        self.scenes, self.designs = scene_folder.resolve(), designs.resolve()
        self._changing = threading.RLock()
        self._folders = _told(self.scenes, self.designs, Path.cwd(), Path(os.path.expanduser("~")))

    @classmethod
    def of(cls, given: Path | None, usual: Path = Path("outputs")) -> tuple[Workspace, str]:
        """The workspace of the command's argument, and the page that it opens.

        None: scenes and designs lie in `usual`.  A scene file: it and its neighbours, designs in `usual`.  A design's
        folder: it and its neighbours.  Another folder: scenes and designs lie there.
        """
        if given is None:
            return cls(usual, usual), "/"
        if given.is_file():
            if given.suffix != ".toml" or not NAME.fullmatch(given.stem):
                raise SceneError(f"{given}: is no scene file; give a TOML file, such as my-lens.toml, or a folder")
            return cls(given.parent, usual), f"/scene/{given.stem}"
        if not given.is_dir():
            raise SceneError(f"{given}: no such scene file or folder; give one that is there, or nothing")
        if any((given / name).is_file() for name in DESIGN):
            given = given.resolve()
            if not NAME.fullmatch(given.name):
                raise SceneError(f"{given}: is no name of a design; call the folder by letters, digits, '-' and '_'")
            return cls(given.parent, given.parent), f"/design/{given.name}"
        return cls(given, given), "/"

    def without_paths(self, sentence: str) -> str:
        """A sentence for the page, without the folders of this machine."""
        return self._folders.sub(lambda found: "" if found[0][-1] in "/\\" else "this folder", sentence)

    # ---- scenes ----

    def scene_names(self) -> list[str]:
        """The scene files, the latest first."""
        paths = self.scenes.glob("*.toml") if self.scenes.is_dir() else ()
        known = [path for path in paths if NAME.fullmatch(path.stem) and self._is_own(path) and path.is_file()]
        return [path.stem for path in sorted(known, key=lambda path: -path.stat().st_mtime)]

    def path(self, name: str) -> Path:
        """The file of a scene; SceneError for a name that is none, or a link that leads out of the workspace."""
        if not NAME.fullmatch(name):
            raise SceneError(f"{name!r}: is no name of a scene; give letters, digits, '-' and '_'")
        path = self.scenes / f"{name}.toml"
        self._own(path)
        self._own(files.beside(path, UNSAVED))
        return path

    def _own(self, path: Path) -> Path:
        """Return the path without its links.  SceneError if they lead out of the workspace's folders."""
        try:
            return files.within(path, self.scenes, self.designs)
        except ValueError as error:
            raise SceneError(f"{path.name}: {error}; put there what it leads to") from None

    def _is_own(self, path: Path) -> bool:
        """Is the path none that leads out of the workspace's folders?"""
        try:
            self._own(path)
        except SceneError:
            return False
        return True

    def opened(self, name: str) -> Opened:
        """A scene with the changes that are not saved yet.  SceneError if there is no such file."""
        path = self.path(name)
        with self._changing:
            unsaved = files.beside(path, UNSAVED)
            if not unsaved.is_file():
                return Opened(name, self._text(path), saved=True)
            text = self._text(unsaved).partition("\n")[2]
            return Opened(name, text, saved=path.is_file() and text == self._text(path))

    def change(self, name: str, text: str) -> Opened:
        """Take the text of a scene, right or wrong, as the one being edited."""
        path, data = self.path(name), _encoded(name, _unix(text))
        if len(data) > scene_file.LARGEST_FILE:
            raise SceneError(f"{name}: holds over {scene_file.LARGEST_FILE / 1e6:g} MB, which is no scene; shorten it")
        with self._changing:
            unsaved = files.beside(path, UNSAVED)
            before = self._text(unsaved).partition("\n")[0] if unsaved.is_file() else _digest(self._text(path))
            files.put(unsaved, f"{before}\n".encode(), data)  # first the hash of the file as it was when editing began
            return self.opened(name)

    def edit(self, name: str, by: Callable[[str], str]) -> Opened:
        """Make another text of the one being edited; no other change comes in between."""
        with self._changing:
            return self.change(name, by(self.opened(name).text))

    def save(self, name: str, anyway: bool = False) -> Opened:
        """Put the text into the scene file.  SceneError if another program wrote the file since editing began."""
        path = self.path(name)
        with self._changing:
            unsaved = files.beside(path, UNSAVED)
            if unsaved.is_file():
                before, _, text = self._text(unsaved).partition("\n")
                now = _digest(self._text(path)) if path.is_file() else ""
                if not anyway and now not in (before, _digest(text)):
                    raise SceneError(
                        f"{path.name}: was changed by another program since it was opened here; "
                        "save again to replace it, or drop the changes made here"
                    )
                files.put(path, _as_written(path, text))
                unsaved.unlink()
            return self.opened(name)

    def drop(self, name: str) -> Opened:
        """Forget the changes that are not saved."""
        with self._changing:
            files.beside(self.path(name), UNSAVED).unlink(missing_ok=True)
        return self.opened(name)

    def scene(self, name: str, text: str) -> Scene:
        """The scene that a text makes, its files relative to the scene file.  SceneError."""
        return self._loaded(self.path(name), text)

    def _loaded(self, path: Path, text: str) -> Scene:
        """The scene that a text makes in the place of a file, whose links may not lead out of the workspace."""
        bounds = (self.scenes, self.designs)
        return scenes.of_text(text, scene_file.tables(text, Path(path.name)), path, bounds=bounds)

    def _text(self, path: Path) -> str:
        """The text of a file of the workspace, as _text."""
        return _text(self._own(path))

    def add(
        self, light: str, image: str | None = None, sample: str | None = None, text: str | None = None,
        template: str | None = None, size: str | None = None,
    ) -> str:  # fmt: skip
        """Write a new scene file for a light of `bstcad new`, or by a template; the scene's name.

        image: the name of an upload.  size: of the plate, as `bstcad new` takes it.
        What is given takes the place of a template's picture, the first of several.
        """
        self.scenes.mkdir(parents=True, exist_ok=True)
        given = None if image is None else self.upload(image).relative_to(self.scenes)
        wanted = {"image": given and template and given.as_posix(), "sample": sample, "text": text}
        key, value = next(((key, value) for key, value in wanted.items() if value), ("", None))
        with self._changing:
            name = self._free_name(template or light)
            start = {"template": template} if template else {"picture": given, "light": light, "size": size}
            new_scene.new_scene(name, self.scenes, **start)
            if key and (template or given is None):
                self._show(name, key, value, plate=None if template else new_scene.Plate.of(light, size))
        return name

    def _show(self, name: str, key: str, value: str, plate: new_scene.Plate | None) -> None:
        """Write another picture into a new scene file, which an error leaves no trace of; plate: that it is of."""
        path = self.path(name)
        try:
            text = self._text(path)
            targets = tables(text)["target"]
            key = f"target[0].{key}" if isinstance(targets, list) and len(targets) > 1 else f"target.{key}"
            text = changed(text, key, value)
            if plate is not None and (blurred := plate.blurred(self.scene(name, text))) is not None:
                text = changed(plate.text(name, blurred=blurred), key, value)  # its limit is for this picture
            files.put(path, _encoded(name, text))
        except BaseException:
            path.unlink()
            raise

    def adopt(self, design: str, folder: Path, written: Path | None = None) -> str:
        """A new scene file for the scene in a folder, with the files that it names; the scene's name.

        written: a file with the text that the scene was made of.  Its comments stay, or those of the scene file of the
        design's name, where that makes the same scene still.
        """
        text = self._text(folder / "scene.toml")
        loaded = self._loaded(folder / "scene.toml", text)
        self.scenes.mkdir(parents=True, exist_ok=True)
        with self._changing:
            name = self._free_name(design.removeprefix("my-"))
            commented = self._commented(loaded, [*filter(None, [written]), self.path(design)])
            if commented is not None:
                files.put(self.path(name), changed(_renamed(commented, name), "name", name).encode())
                return name
            for key, content in contents(loaded):
                if isinstance(content, picture.Picture):
                    place = f"{PICTURES}/{self.keep(content.data)}"
                else:
                    files.put(self.scenes / (place := f"{name}-{content.name}"), content.copy)
                text = changed(text, key if len(loaded.targets) > 1 else key.replace("target[0]", "target"), place)
            files.put(self.path(name), changed(text, "name", name).encode())
        return name

    def _commented(self, scene: Scene, paths: list[Path]) -> str | None:
        """Return the text of the first file that makes a scene, whose number of control points may be chosen anew."""
        alike = [scene, scene.changed({"lens.back.control_points": None})]
        for path in paths:
            with contextlib.suppress(SentenceError):
                text = self._text(path)
                if self.scene(scene.name, text) in alike:
                    return text
        return None

    def _free_name(self, kind: str) -> str:
        """my-KIND, or my-KIND-2 and so on: of neither a scene nor a design that is there."""
        stem, number = f"my-{picture.safe_name(kind)[:70].rstrip('.') or 'lens'}", 1
        name = stem
        while any(os.path.lexists(path) for path in self._of(name)):
            number += 1
            name = f"{stem}-{number}"
        return name

    def _of(self, name: str) -> tuple[Path, Path, Path]:
        """What may be there by a name: a scene, its changes, though somebody took the scene away, and a design."""
        path = self.scenes / f"{name}.toml"
        return path, path.with_name(f".{path.name}.{UNSAVED}"), self.designs / name

    # ---- pictures ----

    def keep(self, data: bytes) -> str:
        """Keep an uploaded picture, whatever its file was called; its name here.  SceneError if it is none."""
        folder = self.scenes / PICTURES
        name = f"{hashlib.sha256(data).hexdigest()[:12]}{picture.kind_of(data)}"
        with picture.decoding("the picture"):
            picture.photo(picture.Picture(name, data))  # its pixels, too
        with self._changing:
            self._own(folder).mkdir(parents=True, exist_ok=True)
            files.put(self._own(folder) / name, data)
        return name

    def upload(self, name: str) -> Path:
        """The file of an upload.  SceneError if there is none of that name."""
        path = self.scenes / PICTURES / name
        if not NAME.fullmatch(name) or not path.is_file():
            raise SceneError(f"{name!r}: no such picture was uploaded; give the picture again")
        self._own(path)
        return path

    # ---- designs ----

    def design_names(self) -> list[str]:
        """The folders of finished designs, the latest first."""
        folders = self.designs.iterdir() if self.designs.is_dir() else ()
        named = (path for path in folders if NAME.fullmatch(path.name) and self._is_own(path))
        known = [path for path in named if (path / DESIGN[0]).is_file()]
        return [path.name for path in sorted(known, key=lambda path: -path.stat().st_mtime)]

    def design(self, name: str) -> Path:
        """The folder of a design, finished or not; SceneError for a name that is none, or a link that leads out."""
        if not NAME.fullmatch(name):
            raise SceneError(f"{name!r}: is no name of a design; give letters, digits, '-' and '_'")
        self._own(self.designs / name)
        return self.designs / name

    def file(self, design: str, name: str) -> Path:
        """A file of a design by its name within the folder; SceneError if it is none, or leads out of it."""
        folder = self.design(design).resolve()
        try:
            path = (folder / name).resolve()
            known = path.is_relative_to(folder) and path.is_file()
        except (OSError, ValueError, RuntimeError):  # a name too long or with a NUL, links that lead back to themselves
            known = False
        if not known or _hidden(Path(name)) or _hidden(path.relative_to(folder)):
            raise SceneError(f"{name!r}: is no file of the design {design}; choose one of its list")
        return path

    def file_names(self, design: str) -> list[str]:
        """The files of a design, those of folders in it too, but hidden ones and links."""
        folder = self.design(design)
        paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink())
        names = (path.relative_to(folder) for path in paths)
        return [name.as_posix() for name in names if not _hidden(name)]


def _renamed(text: str, name: str) -> str:
    """Return a scene's text whose comments name another scene."""
    before = str(tables(text).get("name"))
    for words in (f"bstcad generate {before}.toml", f"bstcad plan {before}.toml", f"outputs/{before}"):
        text = re.sub(rf"{re.escape(words)}(?![\w-])", words.replace(before, name), text)
    return text


def _hidden(name: Path) -> bool:
    """Is a file hidden, or leads its name out of the folder?"""
    return any(part.startswith(".") for part in name.parts)


def _told(*folders: Path) -> re.Pattern:
    """An expression for folders as sentences have them, with the separator behind."""
    known = [folder for folder in folders if folder.is_absolute()]
    both = {each for folder in known for each in (folder, folder.resolve()) if each.parent != each}
    forms = {form for each in both for form in (str(each), each.as_posix(), repr(str(each))[1:-1])}
    any_of = "|".join(map(re.escape, sorted(forms, key=len, reverse=True)))
    return re.compile(rf"(?<![\w.])(?:{any_of})(?:[/\\]+|(?![\w-]))")


def _text(path: Path) -> str:
    """The text of a scene file, without its mark of UTF-8, its lines ending in a line feed.  SceneError."""
    try:
        return _unix(files.contents(path, 2 * scene_file.LARGEST_FILE).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise SceneError(f"{path.name}: is not UTF-8 text; give a TOML file") from None
    except ValueError as error:
        raise SceneError(f"{path.name}: cannot be read ({error}); choose another scene") from None


def _as_written(path: Path, text: str) -> bytes:
    """A text with the mark and the ends of lines that the file there has."""
    try:
        before = files.contents(path, 2 * scene_file.LARGEST_FILE)
    except ValueError:  # it is gone, or no scene any more
        before = b""
    if _is_windows(before):
        text = text.replace("\n", "\r\n")
    return (codecs.BOM_UTF8 if before.startswith(codecs.BOM_UTF8) else b"") + text.encode()


def _encoded(name: str, text: str) -> bytes:
    """A text in UTF-8.  SceneError."""
    try:
        return text.encode()
    except UnicodeEncodeError:
        raise SceneError(f"{name}: holds half a character; write the text again in UTF-8") from None


def _unix(text: str) -> str:
    """A text whose lines all end as Windows has them, with plain ends; TOML takes them for the same."""
    return text.replace("\r\n", "\n") if _is_windows(text.encode(errors="replace")) else text


def _is_windows(data: bytes) -> bool:
    return 0 < data.count(b"\r\n") == data.count(b"\n") == data.count(b"\r")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
