"""The folders of the workbench: scene files with their unsaved changes, pictures, and finished designs.

A scene is named by the stem of its file, and a design by its folder; the pages get no paths.  The text of a scene that
is being edited is in a hidden file beside the scene file, so that no change is lost when a page is closed or the server
is killed.  `save` copies it to the scene file, unless another program has changed that file.
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

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,79}")  # name of a scene or a design: no path, no hidden file
PICTURES = "pictures"  # folder of uploads, beside the scenes
UNSAVED = "unsaved"  # ending of the hidden file with unsaved changes
LARGEST_UPLOAD = 100_000_000  # largest size of a picture or of measured points (bytes)
DESIGN_FILES = ("report.json", "design.npz")  # files by which a design's folder is recognised


@dataclass(frozen=True)
class OpenScene:
    """Scene that is being edited."""

    name: str
    text: str  # text with all changes
    saved: bool  # True if the scene file has this text

    @property
    def revision(self) -> str:
        """Identifier of this text, a hash."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:16]


class Workspace:
    """The folder of the scene files and the folder of the designs; only one thread at a time changes a scene."""

    def __init__(self, scene_folder: Path, designs: Path) -> None:
        self.scenes, self.designs = scene_folder.resolve(), designs.resolve()
        self._changing = threading.RLock()
        self._folders = _folder_pattern(self.scenes, self.designs, Path.cwd(), Path(os.path.expanduser("~")))

    @classmethod
    def of(cls, given: Path | None, usual: Path = Path("outputs")) -> tuple[Workspace, str]:
        """Return the workspace for the command's argument, and the page that it opens.

        None: scenes and designs in `usual`.  A scene file: the scenes of its folder, designs in `usual`.  A design's
        folder: scenes and designs of its parent.  Another folder: scenes and designs in it.
        """
        if given is None:
            return cls(usual, usual), "/"
        if given.is_file():
            if given.suffix != ".toml" or not NAME.fullmatch(given.stem):
                raise SceneError(f"{given}: is not a scene file; give a TOML file, such as my-lens.toml, or a folder")
            return cls(given.parent, usual), f"/scene/{given.stem}"
        if not given.is_dir():
            raise SceneError(f"{given}: no such scene file or folder; give another path, or omit the argument")
        if any((given / name).is_file() for name in DESIGN_FILES):
            given = given.resolve()
            if not NAME.fullmatch(given.name):
                raise SceneError(f"{given}: is not a name of a design; use letters, digits, '-' and '_' for the folder")
            return cls(given.parent, given.parent), f"/design/{given.name}"
        return cls(given, given), "/"

    def without_paths(self, sentence: str) -> str:
        """Return a sentence for the page, without the folders of this machine."""
        return self._folders.sub(lambda found: "" if found[0][-1] in "/\\" else "this folder", sentence)

    # ---- scenes ----

    def scene_names(self) -> list[str]:
        """Return the names of the scenes, the latest first."""
        paths = self.scenes.glob("*.toml") if self.scenes.is_dir() else ()
        known = [path for path in paths if NAME.fullmatch(path.stem) and self._is_own(path) and path.is_file()]
        return [path.stem for path in sorted(known, key=lambda path: -path.stat().st_mtime)]

    def path(self, name: str) -> Path:
        """Return the file of a scene.  SceneError for an invalid name, or a link that leads out of the workspace."""
        if not NAME.fullmatch(name):
            raise SceneError(f"{name!r}: is not a name of a scene; use letters, digits, '-' and '_'")
        path = self.scenes / f"{name}.toml"
        self._own(path)
        self._own(files.beside(path, UNSAVED))
        return path

    def _own(self, path: Path) -> Path:
        """Return the path with links resolved.  SceneError if they lead out of the workspace's folders."""
        try:
            return files.within(path, self.scenes, self.designs)
        except ValueError as error:
            raise SceneError(f"{path.name}: {error}; replace the link by a file") from None

    def _is_own(self, path: Path) -> bool:
        """Return True if no link leads the path out of the workspace's folders."""
        try:
            self._own(path)
        except SceneError:
            return False
        return True

    def opened(self, name: str) -> OpenScene:
        """Return a scene with its unsaved changes.  SceneError if there is no such file."""
        path = self.path(name)
        with self._changing:
            unsaved = files.beside(path, UNSAVED)
            if not unsaved.is_file():
                return OpenScene(name, self._text(path), saved=True)
            text = self._text(unsaved).partition("\n")[2]
            return OpenScene(name, text, saved=path.is_file() and text == self._text(path))

    def change(self, name: str, text: str) -> OpenScene:
        """Store a text, valid or not, as the unsaved text of a scene."""
        path, data = self.path(name), _encoded(name, _with_unix_ends(text))
        if len(data) > scene_file.MAX_SCENE_SIZE:
            raise SceneError(f"{name}: is larger than {scene_file.MAX_SCENE_SIZE / 1e6:g} MB; shorten it")
        with self._changing:
            unsaved = files.beside(path, UNSAVED)
            before = self._text(unsaved).partition("\n")[0] if unsaved.is_file() else _digest(self._text(path))
            files.put(unsaved, f"{before}\n".encode(), data)  # first line: hash of the file before editing
            return self.opened(name)

    def edit(self, name: str, by: Callable[[str], str]) -> OpenScene:
        """Replace the text of a scene with by(text); no other change comes in between."""
        with self._changing:
            return self.change(name, by(self.opened(name).text))

    def save(self, name: str, anyway: bool = False) -> OpenScene:
        """Write the text to the scene file.  SceneError if another program changed it meanwhile, unless `anyway`."""
        path = self.path(name)
        with self._changing:
            unsaved = files.beside(path, UNSAVED)
            if unsaved.is_file():
                before, _, text = self._text(unsaved).partition("\n")
                now = _digest(self._text(path)) if path.is_file() else ""
                if not anyway and now not in (before, _digest(text)):
                    raise SceneError(
                        f"{path.name}: was changed by another program after you opened it here; "
                        "save again to replace it, or discard your changes"
                    )
                files.put(path, _encoded_as(path, text))
                unsaved.unlink()
            return self.opened(name)

    def drop(self, name: str) -> OpenScene:
        """Discard the unsaved changes."""
        with self._changing:
            files.beside(self.path(name), UNSAVED).unlink(missing_ok=True)
        return self.opened(name)

    def scene(self, name: str, text: str) -> Scene:
        """Return the scene of a text, with files relative to the scene file.  SceneError if it is invalid."""
        return self._loaded(self.path(name), text)

    def _loaded(self, path: Path, text: str) -> Scene:
        """Return the scene of a text as if it were in a file; links may not lead out of the workspace."""
        bounds = (self.scenes, self.designs)
        return scenes.of_text(text, scene_file.tables(text, Path(path.name)), path, bounds=bounds)

    def _text(self, path: Path) -> str:
        return _text(self._own(path))

    def add(
        self, light: str, image: str | None = None, sample: str | None = None, text: str | None = None,
        template: str | None = None, size: str | None = None,
    ) -> str:  # fmt: skip
        """Write a new scene file for a light of `bstcad new`, or from a template; return the scene's name.

        image: name of an upload.  size: size of the plate, as in `bstcad new`.
        An image, sample or text replaces the picture of a template, on its first target.
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
        """Set the picture of a new scene file, key = value; an error removes the file.  plate: None for a template."""
        path = self.path(name)
        try:
            text = self._text(path)
            targets = tables(text)["target"]
            key = f"target[0].{key}" if isinstance(targets, list) and len(targets) > 1 else f"target.{key}"
            text = changed(text, key, value)
            if plate is not None and (blurred := plate.blur_rrmsd(self.scene(name, text))) is not None:
                text = changed(plate.text(name, blurred=blurred), key, value)  # the RRMSD limit depends on the picture
            files.put(path, _encoded(name, text))
        except BaseException:
            path.unlink()
            raise

    def adopt(self, design: str, folder: Path, written: Path | None = None, title: str | None = None) -> str:
        """Write a new scene file for the scene in a folder, with the files that it names; return the scene's name.

        title: title of the new scene; None: that of the scene in the folder.
        written: file with the original text of the scene.  The new file has the first of these texts that describes the
        scene: `written`, the scene file with the design's name, the folder's scene.toml.
        """
        text = self._text(folder / "scene.toml")
        loaded = self._loaded(folder / "scene.toml", text)
        self.scenes.mkdir(parents=True, exist_ok=True)
        with self._changing:
            name = self._free_name(design.removeprefix("my-"))
            commented = self._commented(loaded, [*filter(None, [written]), self.path(design)])
            if commented is not None:
                files.put(self.path(name), _titled(changed(_renamed(commented, name), "name", name), title).encode())
                return name
            for key, content in contents(loaded):
                if isinstance(content, picture.Picture) and not content.name.endswith(".csv"):
                    file = f"{PICTURES}/{self.keep(content.data)}"
                else:
                    files.put(self.scenes / (file := f"{name}-{content.name}"), content.copy)
                text = changed(text, key if len(loaded.targets) > 1 else key.replace("target[0]", "target"), file)
            files.put(self.path(name), _titled(changed(text, "name", name), title).encode())
        return name

    def _commented(self, scene: Scene, paths: list[Path]) -> str | None:
        """Return the text of the first of `paths` with this scene, with or without control_points; else None."""
        alike = [scene, scene.changed({"lens.back.control_points": None})]
        for path in paths:
            with contextlib.suppress(SentenceError):
                text = self._text(path)
                if self.scene(scene.name, text) in alike:
                    return text
        return None

    def _free_name(self, kind: str) -> str:
        """Return the first of my-KIND, my-KIND-2, and so on that names no existing scene or design."""
        stem, number = f"my-{picture.safe_name(kind)[:70].rstrip('.') or 'lens'}", 1
        name = stem
        while any(os.path.lexists(path) for path in self._paths(name)):
            number += 1
            name = f"{stem}-{number}"
        return name

    def _paths(self, name: str) -> tuple[Path, Path, Path]:
        """Return the paths that a name may occupy: the scene, its unsaved changes, and the design."""
        path = self.scenes / f"{name}.toml"
        return path, path.with_name(f".{path.name}.{UNSAVED}"), self.designs / name

    # ---- pictures ----

    def keep(self, data: bytes) -> str:
        """Store an uploaded picture under its hash, and return its file name.  SceneError if it is not a picture."""
        folder = self.scenes / PICTURES
        name = f"{hashlib.sha256(data).hexdigest()[:12]}{picture.kind_of(data)}"
        with picture.decoding("the picture"):
            picture.photo(picture.Picture(name, data))  # decode all pixels
        with self._changing:
            self._own(folder).mkdir(parents=True, exist_ok=True)
            files.put(self._own(folder) / name, data)
        return name

    def upload(self, name: str) -> Path:
        """Return the file of an upload.  SceneError if there is no such upload."""
        path = self.scenes / PICTURES / name
        if not NAME.fullmatch(name) or not path.is_file():
            raise SceneError(f"{name!r}: no such picture was uploaded; upload the picture again")
        self._own(path)
        return path

    # ---- designs ----

    def design_names(self) -> list[str]:
        """Return the names of finished designs, the latest first."""
        folders = self.designs.iterdir() if self.designs.is_dir() else ()
        named = (path for path in folders if NAME.fullmatch(path.name) and self._is_own(path))
        known = [path for path in named if (path / DESIGN_FILES[0]).is_file()]
        return [path.name for path in sorted(known, key=lambda path: -path.stat().st_mtime)]

    def design(self, name: str) -> Path:
        """Return the folder of a design, which need not exist.  SceneError for an invalid name or link."""
        if not NAME.fullmatch(name):
            raise SceneError(f"{name!r}: is not a name of a design; use letters, digits, '-' and '_'")
        self._own(self.designs / name)
        return self.designs / name

    def file(self, design: str, name: str) -> Path:
        """Return a file of a design by its name.  SceneError if it does not exist, or leads out of the folder."""
        folder = self.design(design).resolve()
        try:
            path = (folder / name).resolve()
            known = path.is_relative_to(folder) and path.is_file()
        except (OSError, ValueError, RuntimeError):  # name too long or with a NUL; endless links
            known = False
        if not known or _hidden(Path(name)) or _hidden(path.relative_to(folder)):
            raise SceneError(f"{name!r}: is not a file of the design {design}; choose one on its page")
        return path

    def file_names(self, design: str) -> list[str]:
        """Return the names of a design's files, also in inner folders, without hidden files and links."""
        folder = self.design(design)
        paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink())
        names = (path.relative_to(folder) for path in paths)
        return [name.as_posix() for name in names if not _hidden(name)]


def _titled(text: str, title: str | None) -> str:
    return text if title is None or not title.strip() else changed(text, "title", title.strip())


def _renamed(text: str, name: str) -> str:
    """Return a scene's text with a new name of the scene in the commands that its comments quote."""
    before = str(tables(text).get("name"))
    for words in (f"bstcad generate {before}.toml", f"bstcad plan {before}.toml", f"outputs/{before}"):
        text = re.sub(rf"{re.escape(words)}(?![\w-])", words.replace(before, name), text)
    return text


def _hidden(name: Path) -> bool:
    """Return True if a part of the path is hidden, or is '..'."""
    return any(part.startswith(".") for part in name.parts)


def _folder_pattern(*folders: Path) -> re.Pattern:
    """Return a regular expression for folders in sentences, with the separator that follows."""
    known = [folder for folder in folders if folder.is_absolute()]
    paths = {each for folder in known for each in (folder, folder.resolve()) if each.parent != each}
    forms = {form for each in paths for form in (str(each), each.as_posix(), repr(str(each))[1:-1])}
    any_of = "|".join(map(re.escape, sorted(forms, key=len, reverse=True)))
    return re.compile(rf"(?<![\w.])(?:{any_of})(?:[/\\]+|(?![\w-]))")


def _text(path: Path) -> str:
    """Return the text of a scene file, without byte order mark, with Unix line ends.  SceneError if not readable."""
    try:
        return _with_unix_ends(files.contents(path, 2 * scene_file.MAX_SCENE_SIZE).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise SceneError(f"{path.name}: is not UTF-8 text; choose a TOML file") from None
    except ValueError as error:
        raise SceneError(f"{path.name}: cannot be read ({error}); choose another scene") from None


def _encoded_as(path: Path, text: str) -> bytes:
    """Return a text encoded with the byte order mark and the line ends of the file that it replaces."""
    try:
        before = files.contents(path, 2 * scene_file.MAX_SCENE_SIZE)
    except ValueError:  # no such file, or no scene any more
        before = b""
    if _has_windows_ends(before):
        text = text.replace("\n", "\r\n")
    return (codecs.BOM_UTF8 if before.startswith(codecs.BOM_UTF8) else b"") + text.encode()


def _encoded(name: str, text: str) -> bytes:
    try:
        return text.encode()
    except UnicodeEncodeError:
        raise SceneError(f"{name}: the last change contains half a character (a lone surrogate); undo it") from None


def _with_unix_ends(text: str) -> str:
    """Return a text with Unix line ends if all its lines have those of Windows."""
    return text.replace("\r\n", "\n") if _has_windows_ends(text.encode(errors="replace")) else text


def _has_windows_ends(data: bytes) -> bool:
    return 0 < data.count(b"\r\n") == data.count(b"\n") == data.count(b"\r")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
