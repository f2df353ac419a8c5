"""The preview of a scene in a notebook: widgets that change it, the light that follows, and the scene as it then is.

    bench = bstcad.workbench("my-lens.toml")   # shown by the cell
    design = bstcad.design(bench.scene)

Widgets talk to the notebook's own kernel, wherever that runs; a page in a frame would talk to this machine alone.
"""

from __future__ import annotations

import html
import os
import threading
from pathlib import Path
from typing import Any

from bstcad import folder as folders
from bstcad.app import form, preview_json, scene_text
from bstcad.app.followers import with_followers
from bstcad.app.preview import Outdated, Preview, preview
from bstcad.runs import files
from bstcad.runs.files import SentenceError
from bstcad.scene import scene_file
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene, load, of_text

WIDE = "180px"  # of a description


def workbench(scene: Scene | str | os.PathLike[str]) -> Workbench:
    """A scene, or a scene file, to be changed in a notebook while its preview follows.  SceneError."""
    return Workbench(scene)


class Workbench:
    """The widgets of a scene; `scene` is the scene as it is now, `text` its file's text."""

    def __init__(self, scene: Scene | str | os.PathLike[str]) -> None:
        try:
            import ipywidgets
        except ImportError:
            raise SceneError("ipywidgets is not installed; pip install 'bstcad[app]' brings it") from None
        self._widgets = ipywidgets
        self._path = None if isinstance(scene, Scene) else Path(scene).expanduser()
        self.scene = scene if isinstance(scene, Scene) else load(self._path)
        self.text = self.scene.toml() if self._path is None else scene_file.read(self._path)[0]
        self.preview: Preview | None = None  # of the scene, if one could be made
        self._number, self._lock = 0, threading.Lock()
        self._said, self._light = ipywidgets.HTML(), ipywidgets.HTML()
        found = form.form(scene_text.tables(self.text)).first  # the keys that most people need
        self.controls = {field.key: self._control(field) for field in found}
        self.box = ipywidgets.HBox(
            [ipywidgets.VBox([self._light, self._said]), ipywidgets.VBox(list(self.controls.values()))]
        )
        self.refresh()

    def set(self, key: str, value: Any) -> None:
        """Change a value by its dotted key, as the widgets do, and show the preview.  SceneError; then it stays."""
        changes = with_followers(scene_text.tables(self.text), key, value)
        if self._path is None:  # a scene holds its pictures, and its text only names them
            self.scene = self.scene.changed(changes)
            self.text = self.scene.toml()
        else:
            text = self.text
            for other, own in changes.items():
                text = scene_text.changed(text, other, own)
            self.scene, self.text = of_text(text, scene_file.tables(text, self._path), self._path), text
        self.refresh()

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the scene to a file, comments and all, the pictures of a scene that came as an object beside it."""
        path = Path(path).expanduser()
        beside = folders.scene_files(self.scene) if self._path is None else {}
        for name, data in (beside | {folders.SCENE: self.text.encode()}).items():
            files.put(path if name == folders.SCENE else path.with_name(name), data)
        return path

    def refresh(self) -> None:
        """Make the preview of the scene, unless a later change comes meanwhile."""
        with self._lock:
            self._number += 1
            mine = self._number
        try:
            found = preview(self.scene, outdated=lambda: mine != self._number)
        except Outdated:
            return
        except SentenceError as refusal:
            self._say(str(refusal))
            return
        told, page = preview_json.of_preview(found), form.environment().get_template("widget.html.j2").module
        self.preview, self._light.value, self._said.value = found, page.light(told), page.figures(told)

    # ---- what is seen ----

    def _control(self, field: form.Field) -> Any:
        widgets, words = self._widgets, f"{field.label}{f' ({field.unit})' if field.unit else ''}"
        told = {"description": words, "tooltip": field.meaning, "style": {"description_width": WIDE}}
        span = form.slider(field)
        if field.control == "choice":
            options = list(dict.fromkeys(["", *field.choices, field.value]))
            control = widgets.Dropdown(options=options, value=field.value, **told)
        elif span is not None:
            control = widgets.FloatSlider(
                value=float(span.value), min=float(span.least), max=float(span.most), step=float(span.step),
                continuous_update=False, readout_format=".5g", **told,
            )  # fmt: skip
        elif field.control == "check":
            control = widgets.Checkbox(value=(field.value or field.default) == "true", indent=False, **told)
        else:
            control = widgets.Text(value=field.value, continuous_update=False, **told)
        control.observe(lambda change: self._changed(field.key, change["new"]), names="value")
        return control

    def _changed(self, key: str, new: Any) -> None:
        try:
            words = str(new).lower() if isinstance(new, bool) else str(new)
            self.set(key, scene_text.typed(key, words, scene_text.tables(self.text)))
        except SentenceError as refusal:
            self._say(str(refusal))

    def _say(self, sentence: str) -> None:
        self._said.value = f"<p role='alert'><b>{html.escape(sentence)}</b></p>"

    def _repr_mimebundle_(self, **options: Any) -> Any:
        """For a notebook: the widgets."""
        return self.box._repr_mimebundle_(**options)
