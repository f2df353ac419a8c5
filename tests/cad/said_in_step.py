"""What OCC's reader of whole documents (XCAF) finds in a STEP file besides the shape."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from OCP.IFSelect import IFSelect_RetDone
from OCP.Interface import Interface_Static
from OCP.Quantity import Quantity_ColorRGBA
from OCP.STEPCAFControl import STEPCAFControl_Reader
from OCP.TCollection import TCollection_AsciiString, TCollection_ExtendedString
from OCP.TDataStd import TDataStd_Name
from OCP.TDF import TDF_LabelSequence
from OCP.TDocStd import TDocStd_Document
from OCP.XCAFDoc import (
    XCAFDoc_Area,
    XCAFDoc_Centroid,
    XCAFDoc_ColorSurf,
    XCAFDoc_ColorTool,
    XCAFDoc_DimTolTool,
    XCAFDoc_DocumentTool,
    XCAFDoc_GeomTolerance,
    XCAFDoc_Material,
    XCAFDoc_ShapeTool,
    XCAFDoc_Volume,
)

from bstcad.cad.step_reading import silence


@dataclass(frozen=True)
class Said:
    name: str
    faces: list[str | None]
    colour: str | None
    material: str | None
    density: float | None  # g/cm³
    area: float | None
    volume: float | None
    centroid: tuple[float, float, float] | None
    tolerances: list[tuple[str, float, list[str | None]]]  # (kind, mm, names of the faces)


def each(sequence):
    return [sequence.Value(i) for i in range(1, sequence.Length() + 1)]


def name_of(label):
    if not label.IsAttribute(TDataStd_Name.GetID_s()):
        return None
    found = TDataStd_Name()
    label.FindAttribute(TDataStd_Name.GetID_s(), found)
    return TCollection_AsciiString(found.Get(), "?").ToCString()


def attribute(label, kind):
    if not label.IsAttribute(kind.GetID_s()):
        return None
    found = kind()
    label.FindAttribute(kind.GetID_s(), found)
    return found


def read(path: Path) -> Said:
    reader = STEPCAFControl_Reader()
    before = Interface_Static.CVal_s("read.stepcaf.subshapes.name")
    Interface_Static.SetCVal_s("read.stepcaf.subshapes.name", "On")
    for mode in (reader.SetNameMode, reader.SetColorMode, reader.SetMatMode, reader.SetPropsMode, reader.SetGDTMode):
        mode(True)
    document = TDocStd_Document(TCollection_ExtendedString("XmlXCAF"))
    with silence():
        assert reader.ReadFile(str(path)) == IFSelect_RetDone and reader.Transfer(document)
    Interface_Static.SetCVal_s("read.stepcaf.subshapes.name", before)
    shapes, free, parts = XCAFDoc_DocumentTool.ShapeTool_s(document.Main()), TDF_LabelSequence(), TDF_LabelSequence()
    shapes.GetFreeShapes(free)
    [label] = each(free)
    XCAFDoc_ShapeTool.GetSubShapes_s(label, parts)
    colour, materials, tolerances = Quantity_ColorRGBA(), TDF_LabelSequence(), TDF_LabelSequence()
    coloured = XCAFDoc_ColorTool.GetColor_s(label, XCAFDoc_ColorSurf, colour)
    XCAFDoc_DocumentTool.MaterialTool_s(document.Main()).GetMaterialLabels(materials)
    material = attribute(materials.Value(1), XCAFDoc_Material) if materials.Length() else None
    XCAFDoc_DocumentTool.DimTolTool_s(document.Main()).GetGeomToleranceLabels(tolerances)
    area, volume, centroid = (attribute(label, kind) for kind in (XCAFDoc_Area, XCAFDoc_Volume, XCAFDoc_Centroid))
    return Said(
        name_of(label),
        [name_of(part) for part in each(parts)],
        Quantity_ColorRGBA.ColorToHex_s(colour).ToCString().lower() if coloured else None,
        material.GetName().ToCString() if material else None,
        material.GetDensity() if material else None,
        area.Get() if area else None,
        volume.Get() if volume else None,
        centroid.Get().Coord() if centroid else None,
        [_tolerance(one) for one in each(tolerances)],
    )


def _tolerance(label):
    stated, first, second = XCAFDoc_GeomTolerance.Set_s(label).GetObject(), TDF_LabelSequence(), TDF_LabelSequence()
    XCAFDoc_DimTolTool.GetRefShapeLabel_s(label, first, second)
    return stated.GetType().name.rpartition("_")[2], stated.GetValue(), [name_of(face) for face in each(first)]
