"""The workbench of a notebook: widgets that change a scene, with a preview of its light.

    bench = bstcad.workbench("my-lens.toml")   # shown by the cell
    design = bstcad.design(bench.scene)

Widgets work with a kernel on any machine; a page of the workbench's server would need a kernel on the local machine.
"""

from __future__ import annotations

import html
import os
import threading
from pathlib import Path
from typing import Any

from bstcad.app import form, preview_json, scene_text
from bstcad.app.followers import with_followers
from bstcad.designs import folder as folders
from bstcad.planning.preview import Outdated, Preview, preview
from bstcad.runs import files
from bstcad.runs.files import SentenceError
from bstcad.scene import scene_file
from bstcad.scene.errors import SceneError
from bstcad.scene.scene import Scene, load, of_text

DESCRIPTION_WIDTH = "180px"  # width of a widget's label


def workbench(scene: Scene | str | os.PathLike[str]) -> WorkbenchWidget:
    """Return the workbench of a scene or a scene file, to be shown in a notebook.  SceneError for an invalid scene."""
    return WorkbenchWidget(scene)


class WorkbenchWidget:
    """Widgets of a scene; `scene` is the current scene, `text` the text of its file."""

    def __init__(self, scene: Scene | str | os.PathLike[str]) -> None:
        try:
            import ipywidgets
        except ImportError:
            raise SceneError("ipywidgets is not installed; run: pip install 'bstcad[app]'") from None
        self._widgets = ipywidgets
        self._path = None if isinstance(scene, Scene) else Path(scene).expanduser()
        self.scene = scene if isinstance(scene, Scene) else load(self._path)
        self.text = self.scene.toml() if self._path is None else scene_file.read(self._path)[0]
        self.preview: Preview | None = None  # latest preview; None before the first
        self._number, self._lock = 0, threading.Lock()
        self._message, self._light = ipywidgets.HTML(), ipywidgets.HTML()
        found = form.form(scene_text.tables(self.text)).first
        self.controls = {field.key: self._control(field) for field in found}
        self.box = ipywidgets.HBox(
            [ipywidgets.VBox([self._light, self._message]), ipywidgets.VBox(list(self.controls.values()))]
        )
        self.refresh()

    def set(self, key: str, value: Any) -> None:
        """Set a value by its dotted key and show the preview.  SceneError for an invalid value, which is not set."""
        changes = with_followers(scene_text.tables(self.text), key, value)
        if self._path is None:  # a scene object contains its pictures; its text only names them
            self.scene = self.scene.changed(changes)
            self.text = self.scene.toml()
        else:
            text = self.text
            for other, own in changes.items():
                text = scene_text.changed(text, other, own)
            self.scene, self.text = of_text(text, scene_file.tables(text, self._path), self._path), text
        self.refresh()

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the scene to a file with its comments; the pictures of a scene object are written beside the file."""
        path = Path(path).expanduser()
        beside = folders.scene_files(self.scene) if self._path is None else {}
        for name, data in (beside | {folders.SCENE: self.text.encode()}).items():
            files.put(path if name == folders.SCENE else path.with_name(name), data)
        return path

    def refresh(self) -> None:
        """Make and show the preview of the scene, unless a later change replaces it."""
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
        reply, page = preview_json.of_preview(found), form.environment().get_template("widget.html.j2").module
        self.preview, self._light.value, self._message.value = found, page.light(reply), page.figures(reply)

    # ---- widgets ----

    def _control(self, field: form.Field) -> Any:
        widgets, words = self._widgets, f"{field.label}{f' ({field.unit})' if field.unit else ''}"
        common = {"description": words, "tooltip": field.meaning, "style": {"description_width": DESCRIPTION_WIDTH}}
        span = form.slider(field)
        if field.control == "choice":
            options = list(dict.fromkeys(["", *field.choices, field.value]))
            control = widgets.Dropdown(options=options, value=field.value, **common)
        elif span is not None:
            ends = {"min": float(span.minimum), "max": float(span.maximum), "step": float(span.step)}
            common |= {"continuous_update": False, "readout_format": ".5g"}
            control = widgets.FloatSlider(value=float(span.value), **ends, **common)
        elif field.control == "check":
            control = widgets.Checkbox(value=(field.value or field.default) == "true", indent=False, **common)
        else:
            control = widgets.Text(value=field.value, continuous_update=False, **common)
        control.observe(lambda change: self._changed(field.key, change["new"]), names="value")
        return control

    def _changed(self, key: str, new: Any) -> None:
        try:
            words = str(new).lower() if isinstance(new, bool) else str(new)
            self.set(key, scene_text.typed(key, words, scene_text.tables(self.text)))
        except SentenceError as refusal:
            self._say(str(refusal))

    def _say(self, sentence: str) -> None:
        self._message.value = f"<p role='alert'><b>{html.escape(sentence)}</b></p>"

    def _repr_mimebundle_(self, **options: Any) -> Any:
        return self.box._repr_mimebundle_(**options)
