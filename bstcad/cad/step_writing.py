"""Writing STEP files that say what they hold: AP242, or AP214 for older programs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
from OCP.Interface import Interface_Static
from OCP.StepBasic import StepBasic_Product
from OCP.STEPCAFControl import STEPCAFControl_Writer
from OCP.STEPControl import STEPControl_AsIs
from OCP.StepData import StepData_StepModel, StepData_StepWriter
from OCP.TCollection import TCollection_HAsciiString
from OCP.TopoDS import TopoDS_Shape

from bstcad.cad import mass_properties, step_measures
from bstcad.cad.mass_properties import MassProperties
from bstcad.cad.part_document import document, part21_string
from bstcad.cad.silence import silence
from bstcad.cad.solid import face_names, lens_shape
from bstcad.optics.lens import Lens
from bstcad.scene.part import GLASS, METAL, Part

if TYPE_CHECKING:
    import cadquery

SCHEMAS = {"AP242": "AP242DIS", "AP214": "AP214IS"}  # by what OCC calls them
NOTHING = Part()
EPOCH = "SOURCE_DATE_EPOCH"  # seconds since 1970, instead of now: then the same lens is the same file to the last byte


@contextmanager
def _settings(**values: str) -> Iterator[None]:
    """OCC keeps settings of a file in variables of the whole process: set them for one file, then put them back."""
    names = {name: f"write.{name.replace('_', '.')}" for name in values}
    before = {name: Interface_Static.CVal_s(key) for name, key in names.items()}
    try:
        for name, key in names.items():
            Interface_Static.SetCVal_s(key, values[name])
        yield
    finally:
        for name, key in names.items():
            Interface_Static.SetCVal_s(key, before[name])


def write(
    shape: cadquery.Shape | TopoDS_Shape, path: str | Path, name: str, part: Part = NOTHING, faces: Sequence[str] = (),
    properties: MassProperties | None = None,
) -> None:  # fmt: skip
    """Write the shape (cadquery's or OCC's) as STEP in mm, as `encode` does.

    ValueError if STEP cannot express it, OSError if the file cannot be written.
    """
    Path(path).write_bytes(encode(shape, name, part, faces, properties))


def write_lens(lens: Lens, path: str | Path, name: str, part: Part | None = None) -> None:
    """Write the exact solid of the lens, its faces named, its area, volume and centroid stated.

    part: what else is said of it; None: a colour.  ValueError if its faces bound none.
    """
    part = part or Part(colour=METAL if lens.reflects else GLASS)
    shape = lens_shape(lens)
    write(shape, path, name, part, face_names(lens), mass_properties.of_lens(lens))


def encode(
    shape: cadquery.Shape | TopoDS_Shape, name: str, part: Part = NOTHING, faces: Sequence[str] = (),
    properties: MassProperties | None = None,
) -> bytes:  # fmt: skip
    """The text of the STEP file of a shape, one product called `name`.

    part: its number, who made it, its colour and material, the tolerance of the face named "back".
    faces: the names of all faces, in the order of shape.Faces(), which is TopExp_Explorer's; () names none.
    properties: to state, from which a reader sees whether it got the same.
    """
    writer = STEPCAFControl_Writer()  # OCC's variables exist only once a writer does
    with _settings(step_schema=SCHEMAS[part.schema], stepcaf_subshapes_name="On"), silence():
        held = document(getattr(shape, "wrapped", shape), part, faces)
        if not writer.Transfer(held, STEPControl_AsIs):
            raise ValueError(f"{name}: OCC cannot express this shape in STEP; check that the solid is valid")
    control = writer.ChangeWriter()
    model = control.Model()
    step_measures.mend(model)
    if properties is not None:
        step_measures.state(model, properties)
    _label(model, name, part)
    text, stream = StepData_StepWriter(model), BytesIO()
    reals = text.FloatWriter()  # as OCC sets it, zeros are suppressed, and with them digits: -13.71428571428
    reals.SetFormat("%.16E")
    reals.SetFormatForRange("%.14f", 0.1, 1e3)
    text.SendModel(control.WS().Protocol())
    text.Print(stream)
    return stream.getvalue()


def _label(model: StepData_StepModel, name: str, part: Part) -> None:
    """Product and header of the one shape in a model (OCC would number a name it has seen before)."""
    text = TCollection_HAsciiString(part21_string(name))
    product = step_measures.first(model, StepBasic_Product)
    product.SetId(text if part.number is None else TCollection_HAsciiString(part21_string(part.number)))
    product.SetName(text)
    header = APIHeaderSection_MakeHeader(model)
    header.SetName(text)
    seconds = os.environ.get(EPOCH, "")
    if seconds.isdecimal() and len(seconds) < 12:  # https://reproducible-builds.org/specs/source-date-epoch
        written = datetime.fromtimestamp(int(seconds), UTC)
        header.SetTimeStamp(TCollection_HAsciiString(written.strftime("%Y-%m-%dT%H:%M:%S")))
    header.SetOriginatingSystem(TCollection_HAsciiString("bstcad"))
    for set_value, said in ((header.SetAuthorValue, part.author), (header.SetOrganizationValue, part.organisation)):
        set_value(1, TCollection_HAsciiString(part21_string(said or "")))
    header.SetAuthorisation(TCollection_HAsciiString(""))
    header.SetDescriptionValue(1, TCollection_HAsciiString("freeform lens"))
