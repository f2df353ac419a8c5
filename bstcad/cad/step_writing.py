"""Writing STEP files that name and describe their part: AP242, or AP214 for older programs.

OCC writes the solid with the names of its faces, colour, material and profile tolerances (its XCAF document).  Then its
model is mended, since OCC calls the width of a tolerance metres though it is in mm, and a density in g/cm³ one in
g³ cm²; and area, volume and centroid are added as properties of the part, which OCC would tie to the solid by a second
representation of it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
from OCP.Interface import Interface_Static
from OCP.Quantity import Quantity_ColorRGBA
from OCP.StepBasic import (
    StepBasic_DerivedUnit,
    StepBasic_DerivedUnitElement,
    StepBasic_HArray1OfDerivedUnitElement,
    StepBasic_MeasureValueMember,
    StepBasic_Product,
    StepBasic_ProductRelatedProductCategory,
    StepBasic_SiPrefix,
    StepBasic_SiUnitAndLengthUnit,
    StepBasic_SiUnitAndMassUnit,
    StepBasic_SiUnitName,
    StepBasic_Unit,
)
from OCP.STEPCAFControl import STEPCAFControl_Writer
from OCP.STEPControl import STEPControl_AsIs
from OCP.StepData import StepData_StepModel, StepData_StepWriter
from OCP.StepDimTol import StepDimTol_GeometricTolerance
from OCP.StepGeom import StepGeom_CartesianPoint
from OCP.StepRepr import (
    StepRepr_CharacterizedDefinition,
    StepRepr_HArray1OfRepresentationItem,
    StepRepr_MeasureRepresentationItem,
    StepRepr_ProductDefinitionShape,
    StepRepr_PropertyDefinition,
    StepRepr_PropertyDefinitionRepresentation,
    StepRepr_Representation,
    StepRepr_RepresentationItem,
    StepRepr_RepresentedDefinition,
)
from OCP.StepShape import StepShape_ShapeDefinitionRepresentation
from OCP.TCollection import TCollection_ExtendedString
from OCP.TCollection import TCollection_HAsciiString as Text
from OCP.TDataStd import TDataStd_Name
from OCP.TDF import TDF_LabelSequence
from OCP.TDocStd import TDocStd_Document
from OCP.TopAbs import TopAbs_FACE
from OCP.TopoDS import TopoDS_Shape
from OCP.XCAFDimTolObjects import XCAFDimTolObjects_GeomToleranceObject
from OCP.XCAFDimTolObjects import XCAFDimTolObjects_GeomToleranceType as Tolerance
from OCP.XCAFDoc import XCAFDoc_ColorSurf, XCAFDoc_DocumentTool, XCAFDoc_GeomTolerance

from bstcad.cad import step_nets
from bstcad.cad.solid import lens_shape
from bstcad.cad.step_reading import parts_of, silence
from bstcad.optics import quadrature
from bstcad.optics.lens import Lens
from bstcad.optics.quadrature import MassProperties
from bstcad.scene.mount import LENS_COLOUR, MIRROR_COLOUR, Part

if TYPE_CHECKING:
    import cadquery

SCHEMAS = {"AP242": "AP242DIS", "AP214": "AP214IS"}  # by the names that OCC gives them
NOTHING = Part()
EPOCH = "SOURCE_DATE_EPOCH"  # seconds since 1970, instead of now: then the same lens is the same file to the last byte
MILLI, METRE = StepBasic_SiPrefix.StepBasic_spMilli, StepBasic_SiUnitName.StepBasic_sunMetre
PER_VOLUME = -3.0  # exponent of the length in a density


def write(
    shape: cadquery.Shape | TopoDS_Shape, path: str | Path, name: str, part: Part = NOTHING, faces: Sequence[str] = (),
    properties: MassProperties | None = None,
) -> None:  # fmt: skip
    """Write the shape (cadquery's or OCC's) as STEP in mm: see `encoded`."""
    with Path(path).open("wb") as file:
        file.writelines(encoded(shape, name, part, faces=faces, properties=properties))


def write_lens(
    lens: Lens, path: str | Path, name: str, part: Part | None = None, properties: MassProperties | None = None
) -> None:
    """Write the exact solid of the lens with names of its faces, area, volume and centroid.

    part: the file states its facts; None: a colour.  properties: those of the lens, where they are known already.
    ValueError if the lens's faces bound no solid.
    """
    part = part or Part(colour=LENS_COLOUR if lens.passes.enters else MIRROR_COLOUR)
    shape, faces = lens_shape(lens)
    write(shape, path, name, part, faces=faces, properties=properties or quadrature.of_lens(lens))


def encoded(
    shape: cadquery.Shape | TopoDS_Shape, name: str, part: Part = NOTHING, faces: Sequence[str] = (),
    properties: MassProperties | None = None,
) -> Iterator[bytes]:  # fmt: skip
    """The text of the STEP file of a shape, one product called `name`, in parts.

    part: its number, author, colour and material, and the tolerances of its faces "back" and "front".
    faces: the names of all faces, in the order of shape.Faces(); () names none.
    properties: area, volume and centroid, by which a reader of the file can check the shape.
    """
    writer = STEPCAFControl_Writer()  # OCC's variables exist only once a writer does
    with _settings(schema=SCHEMAS[part.schema]), silence():
        shape, nets = step_nets.with_stand_ins(getattr(shape, "wrapped", shape))
        document = _document(shape, part, faces)
        if not writer.Transfer(document, STEPControl_AsIs):
            raise ValueError(f"{name}: OCC cannot express this shape in STEP; check that the solid is valid")
    control = writer.ChangeWriter()
    model = control.Model()
    _mend(model)
    if properties is not None:
        _add_properties(model, properties)
    _label(model, name, part)
    stand_ins = step_nets.stand_ins_of(model, len(nets))
    text, stream = StepData_StepWriter(model), BytesIO()
    reals = text.FloatWriter()  # as OCC sets it, zeros are suppressed, and with them digits: -13.71428571428
    reals.SetFormat(step_nets.SCIENTIFIC)
    reals.SetFormatForRange(step_nets.FIXED, step_nets.LEAST, step_nets.MOST)
    text.SendModel(control.WS().Protocol())
    text.Print(stream)
    return step_nets.filled_in(stream.getvalue(), stand_ins, nets)


@contextmanager
def _settings(schema: str) -> Iterator[None]:
    """OCC keeps settings of a file in variables of the whole process: set them for one file, then put them back."""
    wanted = {"write.step.schema": schema, "write.stepcaf.subshapes.name": "On"}
    before = {key: Interface_Static.CVal_s(key) for key in wanted}
    try:
        for key, value in wanted.items():
            Interface_Static.SetCVal_s(key, value)
        yield
    finally:
        for key, value in before.items():
            Interface_Static.SetCVal_s(key, value)


def part21_string(name: str) -> str:
    r"""Part 21 is ASCII: any other character, and the backslash, becomes \X2\, its hex digits in UTF-16, \X0\."""

    def escape(c: str) -> str:
        return c if " " <= c <= "~" and c != "\\" else "\\X2\\" + c.encode("utf-16-be").hex().upper() + "\\X0\\"

    return "".join(map(escape, name))


# ---- OCC's document ------------------------------------------------------------------------------------------------


def _document(shape: TopoDS_Shape, part: Part, faces: Sequence[str]) -> TDocStd_Document:
    """The shape as the document's one part."""
    document = TDocStd_Document(TCollection_ExtendedString("XmlXCAF"))
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    label = shapes.AddShape(shape, False)
    labels = [shapes.AddSubShape(label, face) for face in parts_of(shape, TopAbs_FACE)] if faces else []
    for name, face in zip(faces, labels, strict=True):
        TDataStd_Name.Set_s(face, TCollection_ExtendedString(name))
    if part.colour is not None:
        colour = Quantity_ColorRGBA()
        Quantity_ColorRGBA.ColorFromHex_s(part.colour, colour)
        XCAFDoc_DocumentTool.ColorTool_s(document.Main()).SetColor(label, colour, XCAFDoc_ColorSurf)
    if part.material is not None:
        texts = (part.material, part.material, "density measure", "POSITIVE_RATIO_MEASURE")
        name, description, measure, kind = (Text(part21_string(text)) for text in texts)
        materials = XCAFDoc_DocumentTool.MaterialTool_s(document.Main())
        materials.SetMaterial(label, name, description, part.density or 0.0, measure, kind)
    for name, width in (("back", part.surface_profile), ("front", part.front_profile)):
        toleranced = TDF_LabelSequence()
        for face in (face for its, face in zip(faces, labels, strict=True) if its == name):
            toleranced.Append(face)
        if width is not None and toleranced.Length():  # a plane front in the plane of a flange is no face by itself
            _add_profile(document, toleranced, width)
    return document


def _add_profile(document: TDocStd_Document, faces: TDF_LabelSequence, width: float) -> None:
    """A profile tolerance of a surface, without a datum: a zone of this width (mm) about the surface as written."""
    tools = XCAFDoc_DocumentTool.DimTolTool_s(document.Main())
    label, tolerance = tools.AddGeomTolerance(), XCAFDimTolObjects_GeomToleranceObject()
    tolerance.SetType(Tolerance.XCAFDimTolObjects_GeomToleranceType_ProfileOfSurface)
    tolerance.SetValue(width)
    XCAFDoc_GeomTolerance.Set_s(label).SetObject(tolerance)
    tools.SetGeomTolerance(faces, label)


# ---- the model of the file -----------------------------------------------------------------------------------------


def _first(model: StepData_StepModel, kind: type) -> Any:
    """The first entity of a kind: of those of the product, which stand before its shape."""
    entities = (model.Value(i) for i in range(1, model.NbEntities() + 1))
    return next(entity for entity in entities if isinstance(entity, kind))


def _mend(model: StepData_StepModel) -> None:
    """Let the tolerances be in mm, and a density in g/cm³: they stand behind the shape and the product's category."""
    for entity in (model.Value(i) for i in range(model.NbEntities(), 0, -1)):
        if isinstance(entity, StepBasic_ProductRelatedProductCategory):
            return
        if isinstance(entity, StepDimTol_GeometricTolerance):
            entity.Magnitude().UnitComponent().NamedUnit().SetPrefix(MILLI)
        elif isinstance(entity, StepBasic_DerivedUnit):  # there is none but the density's
            for element in (entity.ElementsValue(i) for i in range(1, entity.NbElements() + 1)):
                element.SetExponent(1.0 if isinstance(element.Unit(), StepBasic_SiUnitAndMassUnit) else PER_VOLUME)


def _add_properties(model: StepData_StepModel, properties: MassProperties) -> None:
    """Add area, volume and centroid as geometric validation properties of the part.

    Names as in "Recommended Practices for Geometric and Assembly Validation Properties" of the CAx Interoperability
    Forum.
    """
    part = _first(model, StepRepr_ProductDefinitionShape)
    context = _first(model, StepShape_ShapeDefinitionRepresentation).UsedRepresentation().ContextOfItems()
    point = StepGeom_CartesianPoint()
    point.Init3D(Text("centre point"), *properties.centroid)
    items: dict[str, StepRepr_RepresentationItem] = {
        "surface area": _measure("surface area measure", "AREA_MEASURE", properties.area, 2.0),
        "volume": _measure("volume measure", "VOLUME_MEASURE", properties.volume, 3.0),
        "centroid": point,
    }
    for name, item in items.items():
        held = StepRepr_HArray1OfRepresentationItem(1, 1)
        held.SetValue(1, item)
        target, defined = StepRepr_CharacterizedDefinition(), StepRepr_RepresentedDefinition()
        target.SetValue(part)
        definition, representation = StepRepr_PropertyDefinition(), StepRepr_Representation()
        definition.Init(Text("geometric validation property"), True, Text(name), target)
        representation.Init(Text(name), held, context)
        defined.SetValue(definition)
        both = StepRepr_PropertyDefinitionRepresentation()
        both.Init(defined, representation)
        model.AddWithRefs(both)


def _measure(name: str, kind: str, value: float, exponent: float) -> StepRepr_MeasureRepresentationItem:
    """A number of mm, mm² or mm³."""
    millimetre, element = StepBasic_SiUnitAndLengthUnit(), StepBasic_DerivedUnitElement()
    millimetre.Init(True, MILLI, METRE)
    element.Init(millimetre, exponent)
    elements = StepBasic_HArray1OfDerivedUnitElement(1, 1)
    elements.SetValue(1, element)
    derived = StepBasic_DerivedUnit()
    derived.Init(elements)
    unit, number, item = StepBasic_Unit(), StepBasic_MeasureValueMember(), StepRepr_MeasureRepresentationItem()
    unit.SetValue(derived)
    number.SetName(kind)
    number.SetReal(value)
    item.Init(Text(name), number, unit)
    return item


def _label(model: StepData_StepModel, name: str, part: Part) -> None:
    """Product and header of the one shape in a model (OCC would number a name it has seen before)."""
    text = Text(part21_string(name))
    product = _first(model, StepBasic_Product)
    product.SetId(text if part.number is None else Text(part21_string(part.number)))
    product.SetName(text)
    header = APIHeaderSection_MakeHeader(model)
    header.SetName(text)
    seconds = os.environ.get(EPOCH, "")
    if seconds.isdecimal() and len(seconds) < 12:  # https://reproducible-builds.org/specs/source-date-epoch
        header.SetTimeStamp(Text(datetime.fromtimestamp(int(seconds), UTC).strftime("%Y-%m-%dT%H:%M:%S")))
    header.SetOriginatingSystem(Text("bstcad"))
    for set_value, value in ((header.SetAuthorValue, part.author), (header.SetOrganizationValue, part.organisation)):
        set_value(1, Text(part21_string(value or "")))
    header.SetAuthorisation(Text(""))
    header.SetDescriptionValue(1, Text("freeform lens"))
