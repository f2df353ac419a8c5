"""Writing of STEP files with name and description of the part: AP242, or AP214 for older programs.

OCC writes the solid with the names of its faces, colour, material and profile tolerances (an XCAF document).  Units in
OCC's model are corrected: it states metres for the width of a tolerance in mm, and g³ cm² for a density in g/cm³.
Area, volume and centroid are added as properties of the part; OCC would need a second representation of the solid.
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
from bstcad.cad.step_reading import parts_of, quiet_occ
from bstcad.optics.lens import face_integrals
from bstcad.optics.lens.face_integrals import MassProperties
from bstcad.optics.lens.lens import Lens
from bstcad.scene.mount import LENS_COLOUR, MIRROR_COLOUR, Part

if TYPE_CHECKING:
    import cadquery

SCHEMAS = {"AP242": "AP242DIS", "AP214": "AP214IS"}  # schema -> its name in OCC
NO_FACTS = Part()
TIME_VARIABLE = "SOURCE_DATE_EPOCH"  # environment variable that sets the file's time (s since 1970), for equal bytes
MILLI, METRE = StepBasic_SiPrefix.StepBasic_spMilli, StepBasic_SiUnitName.StepBasic_sunMetre
DENSITY_EXPONENT = -3.0  # exponent of the length in a density


def write(
    shape: cadquery.Shape | TopoDS_Shape,
    path: str | Path,
    name: str,
    part: Part = NO_FACTS,
    faces: Sequence[str] = (),
    properties: MassProperties | None = None,
) -> None:
    """Write a shape of cadquery or OCC as a STEP file in mm; see `encode`."""
    with Path(path).open("wb") as file:
        file.writelines(encode(shape, name, part, faces=faces, properties=properties))


def write_lens(
    lens: Lens, path: str | Path, name: str, part: Part | None = None, properties: MassProperties | None = None
) -> None:
    """Write the exact solid of the lens with the names of its faces, area, volume and centroid.

    part: data that the file states; None: only a colour.  properties: area, volume and centroid; None: computed.
    Raises ValueError if the faces of the lens do not bound a solid.
    """
    part = part or Part(colour=LENS_COLOUR if lens.passes.enters else MIRROR_COLOUR)
    shape, faces = lens_shape(lens)
    write(shape, path, name, part, faces=faces, properties=properties or face_integrals.of_lens(lens))


def encode(
    shape: cadquery.Shape | TopoDS_Shape,
    name: str,
    part: Part = NO_FACTS,
    faces: Sequence[str] = (),
    properties: MassProperties | None = None,
) -> Iterator[bytes]:
    """Yield pieces of the text of a shape's STEP file, with one product called `name`.

    part: schema, number, author, colour, material and density, and the tolerances of the faces.
    faces: names of all faces, in the order of shape.Faces(); (): no names.
    properties: area, volume and centroid, with which a reader of the file can check the shape; None: not stated.
    """
    writer = STEPCAFControl_Writer()  # OCC's process-wide variables exist only after a writer is made
    with _settings(schema=SCHEMAS[part.schema]), quiet_occ():
        shape, nets = step_nets.with_placeholders(getattr(shape, "wrapped", shape))
        document = _document(shape, part, faces)
        if not writer.Transfer(document, STEPControl_AsIs):
            raise ValueError(f"{name}: OpenCASCADE cannot express this shape in STEP; check that the solid is valid")
    control = writer.ChangeWriter()
    model = control.Model()
    _correct_units(model)
    if properties is not None:
        _add_properties(model, properties)
    _label(model, name, part)
    placeholders = step_nets.placeholder_numbers(model, len(nets))
    text, stream = StepData_StepWriter(model), BytesIO()
    reals = text.FloatWriter()  # OCC's default suppresses zeros, and digits with them: -13.71428571428
    reals.SetFormat(step_nets.SCIENTIFIC_FORMAT)
    reals.SetFormatForRange(step_nets.FIXED_FORMAT, step_nets.FIXED_MIN, step_nets.FIXED_MAX)
    text.SendModel(control.WS().Protocol())
    text.Print(stream)
    return step_nets.fill_in_nets(stream.getvalue(), placeholders, nets)


@contextmanager
def _settings(schema: str) -> Iterator[None]:
    """Set OCC's process-wide variables for one file, then restore them."""
    settings = {"write.step.schema": schema, "write.stepcaf.subshapes.name": "On"}
    before = {key: Interface_Static.CVal_s(key) for key in settings}
    try:
        for key, value in settings.items():
            Interface_Static.SetCVal_s(key, value)
        yield
    finally:
        for key, value in before.items():
            Interface_Static.SetCVal_s(key, value)


def part21_string(name: str) -> str:
    r"""Encode text for Part 21: backslashes and all except printable ASCII become \X2\ UTF-16 in hex \X0\."""

    def escape(c: str) -> str:
        return c if " " <= c <= "~" and c != "\\" else "\\X2\\" + c.encode("utf-16-be").hex().upper() + "\\X0\\"

    return "".join(map(escape, name))


# ---- OCC's document ------------------------------------------------------------------------------------------------


def _document(shape: TopoDS_Shape, part: Part, faces: Sequence[str]) -> TDocStd_Document:
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
    for name, width in part.profiles.items():
        toleranced = TDF_LabelSequence()
        for face in (face for its, face in zip(faces, labels, strict=True) if its == name):
            toleranced.Append(face)
        if width is not None and toleranced.Length():  # a plane front in the plane of a flange has no face of its own
            _add_profile(document, toleranced, width)
    return document


def _add_profile(document: TDocStd_Document, faces: TDF_LabelSequence, width: float) -> None:
    """Add a profile tolerance without a datum: a zone of `width` (mm) centred on the written surface of the faces."""
    tools = XCAFDoc_DocumentTool.DimTolTool_s(document.Main())
    label, tolerance = tools.AddGeomTolerance(), XCAFDimTolObjects_GeomToleranceObject()
    tolerance.SetType(Tolerance.XCAFDimTolObjects_GeomToleranceType_ProfileOfSurface)
    tolerance.SetValue(width)
    XCAFDoc_GeomTolerance.Set_s(label).SetObject(tolerance)
    tools.SetGeomTolerance(faces, label)


# ---- the model of the file -----------------------------------------------------------------------------------------


def _first_entity(model: StepData_StepModel, kind: type) -> Any:
    """Return the first entity of a kind: an entity of the product, since these precede the entities of the shape."""
    entities = (model.Value(i) for i in range(1, model.NbEntities() + 1))
    return next(entity for entity in entities if isinstance(entity, kind))


def _correct_units(model: StepData_StepModel) -> None:
    """Set the units of tolerances (mm) and density (g/cm³), searching from the end back to the product's category."""
    for entity in (model.Value(i) for i in range(model.NbEntities(), 0, -1)):
        if isinstance(entity, StepBasic_ProductRelatedProductCategory):
            return
        if isinstance(entity, StepDimTol_GeometricTolerance):
            entity.Magnitude().UnitComponent().NamedUnit().SetPrefix(MILLI)
        elif isinstance(entity, StepBasic_DerivedUnit):  # unit of the density, the only derived unit
            for element in (entity.ElementsValue(i) for i in range(1, entity.NbElements() + 1)):
                is_mass = isinstance(element.Unit(), StepBasic_SiUnitAndMassUnit)
                element.SetExponent(1.0 if is_mass else DENSITY_EXPONENT)


def _add_properties(model: StepData_StepModel, properties: MassProperties) -> None:
    """Add area, volume and centroid as geometric validation properties of the part.

    Names as in "Recommended Practices for Geometric and Assembly Validation Properties" (CAx Interoperability Forum).
    """
    part = _first_entity(model, StepRepr_ProductDefinitionShape)
    context = _first_entity(model, StepShape_ShapeDefinitionRepresentation).UsedRepresentation().ContextOfItems()
    point = StepGeom_CartesianPoint()
    point.Init3D(Text("centre point"), *properties.centroid)
    items: dict[str, StepRepr_RepresentationItem] = {
        "surface area": _measure("surface area measure", "AREA_MEASURE", properties.area, 2.0),
        "volume": _measure("volume measure", "VOLUME_MEASURE", properties.volume, 3.0),
        "centroid": point,
    }
    for name, item in items.items():
        array = StepRepr_HArray1OfRepresentationItem(1, 1)
        array.SetValue(1, item)
        target, defined = StepRepr_CharacterizedDefinition(), StepRepr_RepresentedDefinition()
        target.SetValue(part)
        definition, representation = StepRepr_PropertyDefinition(), StepRepr_Representation()
        definition.Init(Text("geometric validation property"), True, Text(name), target)
        representation.Init(Text(name), array, context)
        defined.SetValue(definition)
        link = StepRepr_PropertyDefinitionRepresentation()
        link.Init(defined, representation)
        model.AddWithRefs(link)


def _measure(name: str, kind: str, value: float, exponent: float) -> StepRepr_MeasureRepresentationItem:
    """Return a measure whose unit is mm to the power of an exponent."""
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
    """Set the product's name, to which OCC may have added a count, its part number, and the header of the file."""
    text = Text(part21_string(name))
    product = _first_entity(model, StepBasic_Product)
    product.SetId(text if part.number is None else Text(part21_string(part.number)))
    product.SetName(text)
    header = APIHeaderSection_MakeHeader(model)
    header.SetName(text)
    seconds = os.environ.get(TIME_VARIABLE, "")
    if seconds.isdecimal() and len(seconds) < 12:  # https://reproducible-builds.org/specs/source-date-epoch
        header.SetTimeStamp(Text(datetime.fromtimestamp(int(seconds), UTC).strftime("%Y-%m-%dT%H:%M:%S")))
    header.SetOriginatingSystem(Text("bstcad"))
    for set_value, value in ((header.SetAuthorValue, part.author), (header.SetOrganizationValue, part.organisation)):
        set_value(1, Text(part21_string(value or "")))
    header.SetAuthorisation(Text(""))
    header.SetDescriptionValue(1, Text("freeform lens"))
