"""The pictures of a report, drawn by other processes while this one goes on."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor

import numpy as np

from bstcad.cad import mesh as meshes
from bstcad.judges.comparison import Compared
from bstcad.measured.made_part import MadePart
from bstcad.optics.lens import Lens
from bstcad.report import judge_figures, rendering
from bstcad.report.data_sheet import Sheet
from bstcad.report.light_figures import View
from bstcad.runs import worker
from bstcad.scene.scene import Scene
from bstcad.verify.checks import Verification

CELLS = 320  # of the mesh in the 3-D picture, each way


class Pictures:
    """What has been begun, and what it comes to."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._waiting = ThreadPoolExecutor(1)  # for VTK, which draws in a process of its own
        self._others: list[Future] = []
        self._sheet: Future | None = None

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *error: object) -> None:
        self._waiting.shutdown()

    def solid(self, lens: Lens) -> None:
        """Begin the 3-D picture."""
        mesh = meshes.lens_mesh(lens, CELLS)
        self._solid = self._waiting.submit(rendering.lens_picture, mesh)

    def lens(self, lens: Lens) -> None:
        """Begin the maps of the lens and its rays."""
        scene = self._scene
        wanted = scene.target
        self._others.append(
            worker.submit(
                "bstcad.report.figures.draw_lens", scene.source.central, lens, wanted.screen, wanted.seen_from
            )
        )

    def light(self, target: np.ndarray, proof: Verification) -> None:
        """Begin the pictures of the irradiance, of the ghost in it and of its lines."""
        wanted = self._scene.target
        place = (wanted.x, wanted.y, wanted.seen_from, self._scene.optic, wanted.tilt, proof.ghost, proof.lines)
        self._others.append(worker.submit("bstcad.report.figures.draw_light", target, proof.irradiance, *place))

    def sheet(self, sheet: Sheet) -> None:
        """Begin the data sheet of a part."""
        self._sheet = worker.submit("bstcad.report.data_sheet_page.draw", sheet)

    def judges(self, judged: Sequence[Compared]) -> None:
        """Begin the pictures of what other programs see."""
        seen = [one for one in judged if not one.declined]
        if seen:
            pictures = [judge_figures.Pictures(one.name, one.target, one.ours, one.theirs) for one in seen]
            wanted = self._scene.target
            view = View(wanted.x, wanted.y, wanted.seen_from, self._scene.optic, wanted.tilt)
            self._others.append(worker.submit("bstcad.report.judge_figures.draw_judges", pictures, view))

    def part(self, made: MadePart, proof: Verification) -> None:
        """Begin the pictures of a made part."""
        wanted, found = self._scene.target, made.deviation
        view = (wanted.x, wanted.y, wanted.seen_from, self._scene.optic, wanted.tilt)
        place = "bstcad.report.part_figures.draw_part"
        self._others.append(
            worker.submit(
                place, found.x, found.y, found.form, proof.irradiance, made.irradiance, view, made.outliers[:, :2]
            )
        )

    def result(self) -> dict[str, bytes | None]:
        """PNG bytes by name; None for what this machine cannot draw."""
        pictures = {"lens": self._solid.result()}
        for other in self._others:
            pictures |= drawn_or_none(other)
        return pictures

    def data_sheet(self) -> bytes | None:
        """PDF; None if there is none, or the process that drew it died."""
        try:
            return None if self._sheet is None else self._sheet.result()
        except BrokenExecutor:
            return None


def drawn_or_none(pictures: Future) -> dict[str, bytes]:
    """Pictures as they come from the second process; none if that died: a proven lens is worth more."""
    try:
        return pictures.result()
    except BrokenExecutor:
        return {}


class Unseen(Pictures):
    """The pictures of a design that nobody looks at: none."""

    def solid(self, lens: Lens) -> None:
        """Draw nothing."""

    def lens(self, lens: Lens) -> None:
        """Draw nothing."""

    def light(self, target: np.ndarray, proof: Verification) -> None:
        """Draw nothing."""

    def sheet(self, sheet: Sheet) -> None:
        """Draw nothing."""
