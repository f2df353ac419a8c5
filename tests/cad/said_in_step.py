"""The statements of a STEP file besides the shape, by OCC's reader of whole documents (XCAF)."""

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

from bstcad.cad.step_reading import quiet_occ

NAMES = "read.stepcaf.subshapes.name"


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


def labels(fill):
    """The labels that a function of OCC's fills into a sequence."""
    found = TDF_LabelSequence()
    fill(found)
    return [found.Value(i) for i in range(1, found.Length() + 1)]


def attribute(label, kind):
    if not label.IsAttribute(kind.GetID_s()):  # FindAttribute would end the process
        return None
    found = kind()
    label.FindAttribute(kind.GetID_s(), found)
    return found


def name_of(label):
    name = attribute(label, TDataStd_Name)
    return name and TCollection_AsciiString(name.Get(), "?").ToCString()


def read(path: Path) -> Said:
    reader, document = STEPCAFControl_Reader(), TDocStd_Document(TCollection_ExtendedString("XmlXCAF"))
    before = Interface_Static.CVal_s(NAMES)
    Interface_Static.SetCVal_s(NAMES, "On")
    for mode in (reader.SetNameMode, reader.SetColorMode, reader.SetMatMode, reader.SetPropsMode, reader.SetGDTMode):
        mode(True)
    with quiet_occ():
        assert reader.ReadFile(str(path)) == IFSelect_RetDone and reader.Transfer(document)
    Interface_Static.SetCVal_s(NAMES, before)
    main, colour = document.Main(), Quantity_ColorRGBA()
    [label] = labels(XCAFDoc_DocumentTool.ShapeTool_s(main).GetFreeShapes)
    coloured = XCAFDoc_ColorTool.GetColor_s(label, XCAFDoc_ColorSurf, colour)
    materials = labels(XCAFDoc_DocumentTool.MaterialTool_s(main).GetMaterialLabels)
    material = attribute(materials[0], XCAFDoc_Material) if materials else None
    area, volume, centroid = (attribute(label, kind) for kind in (XCAFDoc_Area, XCAFDoc_Volume, XCAFDoc_Centroid))
    return Said(
        name_of(label),
        [name_of(part) for part in labels(lambda found: XCAFDoc_ShapeTool.GetSubShapes_s(label, found))],
        Quantity_ColorRGBA.ColorToHex_s(colour).ToCString().lower() if coloured else None,
        material and material.GetName().ToCString(),
        material and material.GetDensity(),
        area and area.Get(),
        volume and volume.Get(),
        centroid and centroid.Get().Coord(),
        [_tolerance(one) for one in labels(XCAFDoc_DocumentTool.DimTolTool_s(main).GetGeomToleranceLabels)],
    )


def _tolerance(label):
    stated, other = XCAFDoc_GeomTolerance.Set_s(label).GetObject(), TDF_LabelSequence()
    faces = labels(lambda found: XCAFDoc_DimTolTool.GetRefShapeLabel_s(label, found, other))
    return stated.GetType().name.rpartition("_")[2], stated.GetValue(), [name_of(face) for face in faces]
