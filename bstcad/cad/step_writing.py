"""Writing STEP AP242 files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
from OCP.IFSelect import IFSelect_RetDone
from OCP.Interface import Interface_Static
from OCP.StepBasic import StepBasic_Product
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
from OCP.StepData import StepData_StepWriter
from OCP.TCollection import TCollection_HAsciiString
from OCP.TopoDS import TopoDS_Shape

from bstcad.cad.silence import silence
from bstcad.cad.solid import lens_shape
from bstcad.optics.lens import Lens

if TYPE_CHECKING:
    import cadquery

SCHEMA = "AP242DIS"


@contextmanager
def _schema(value: str) -> Iterator[None]:
    """OCC keeps the schema in a variable of the whole process: set it for one file, then put it back."""
    before = Interface_Static.CVal_s("write.step.schema")
    Interface_Static.SetCVal_s("write.step.schema", value)
    try:
        yield
    finally:
        Interface_Static.SetCVal_s("write.step.schema", before)


def write(shape: cadquery.Shape | TopoDS_Shape, path: str | Path, name: str) -> None:
    """Write the shape (cadquery's or OCC's) as STEP AP242 in mm, one product called `name`.

    ValueError if STEP cannot express it, OSError if the file cannot be written.
    """
    Path(path).write_bytes(encode(shape, name))


def write_lens(lens: Lens, path: str | Path, name: str) -> None:
    """Write the exact solid of the lens; ValueError if its faces bound none."""
    write(lens_shape(lens), path, name)


def encode(shape: cadquery.Shape | TopoDS_Shape, name: str) -> bytes:
    """The text of the STEP file of a shape."""
    writer = STEPControl_Writer()  # OCC's variables exist only once a writer does
    with _schema(SCHEMA), silence():
        if writer.Transfer(getattr(shape, "wrapped", shape), STEPControl_AsIs) != IFSelect_RetDone:
            raise ValueError(f"{name}: OCC cannot express this shape in STEP; check that the solid is valid")
    _label(writer, name)
    text, stream = StepData_StepWriter(writer.Model()), BytesIO()
    reals = text.FloatWriter()  # as OCC sets it, zeros are suppressed, and with them digits: -13.71428571428
    reals.SetFormat("%.16E")
    reals.SetFormatForRange("%.14f", 0.1, 1e3)
    text.SendModel(writer.WS().Protocol())
    text.Print(stream)
    return stream.getvalue()


def _label(writer: STEPControl_Writer, name: str) -> None:
    """Product and header of the one shape in the writer's model (OCC would number a name it has seen before)."""
    model = writer.Model()
    text = TCollection_HAsciiString(_part21_string(name))
    entities = (model.Value(i) for i in range(1, model.NbEntities() + 1))
    product = next(entity for entity in entities if isinstance(entity, StepBasic_Product))  # one for the one shape
    product.SetId(text)
    product.SetName(text)
    header = APIHeaderSection_MakeHeader(model)
    header.SetName(text)
    header.SetOriginatingSystem(TCollection_HAsciiString("bstcad"))
    for set_value in (header.SetAuthorValue, header.SetOrganizationValue):
        set_value(1, TCollection_HAsciiString(""))
    header.SetAuthorisation(TCollection_HAsciiString(""))
    header.SetDescriptionValue(1, TCollection_HAsciiString("freeform lens"))


def _part21_string(name: str) -> str:
    r"""Part 21 is ASCII: any other character, and the backslash, becomes \X2\, its hex digits in UTF-16, \X0\."""

    def escape(c: str) -> str:
        return c if " " <= c <= "~" and c != "\\" else "\\X2\\" + c.encode("utf-16-be").hex().upper() + "\\X0\\"

    return "".join(map(escape, name))
