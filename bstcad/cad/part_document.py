"""A solid with what is said of it, as a document of OCC's (XCAF), from which a STEP file is written."""

from __future__ import annotations

from collections.abc import Sequence

from OCP.Quantity import Quantity_ColorRGBA
from OCP.TCollection import TCollection_ExtendedString, TCollection_HAsciiString
from OCP.TDataStd import TDataStd_Name
from OCP.TDF import TDF_Label, TDF_LabelSequence
from OCP.TDocStd import TDocStd_Document
from OCP.TopAbs import TopAbs_FACE
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS_Shape
from OCP.XCAFDimTolObjects import XCAFDimTolObjects_GeomToleranceObject
from OCP.XCAFDimTolObjects import XCAFDimTolObjects_GeomToleranceType as Kind
from OCP.XCAFDoc import XCAFDoc_ColorSurf, XCAFDoc_DocumentTool, XCAFDoc_GeomTolerance

from bstcad.scene.part import Part

PROFILED = {"back": "surface_profile", "front": "front_profile"}  # name of a face: the field of Part for its profile


def document(shape: TopoDS_Shape, part: Part, faces: Sequence[str]) -> TDocStd_Document:
    """The shape as its one part; faces: the names of its faces, in OCC's order, or none.

    ValueError if there are more or fewer names than faces, or no face has the name that a tolerance is for.
    """
    found = TDocStd_Document(TCollection_ExtendedString("XmlXCAF"))
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(found.Main())
    label = shapes.AddShape(shape, False)
    named = [(name, shapes.AddSubShape(label, face)) for name, face in _named(shape, faces)]
    for name, face in named:
        TDataStd_Name.Set_s(face, TCollection_ExtendedString(name))
    if part.colour is not None:
        colour = Quantity_ColorRGBA()
        if not Quantity_ColorRGBA.ColorFromHex_s(part.colour, colour):
            raise ValueError(f'{part.colour!r} is no colour; write it as "#9ed3f5"')
        XCAFDoc_DocumentTool.ColorTool_s(found.Main()).SetColor(label, colour, XCAFDoc_ColorSurf)
    if part.material is not None:
        _say_material(found, label, part)
    for name, key in PROFILED.items():
        if (width := getattr(part, key)) is not None:
            _say_profile(found, name, [face for its, face in named if its == name], width)
    return found


def _named(shape: TopoDS_Shape, names: Sequence[str]) -> list[tuple[str, TopoDS_Shape]]:
    explorer, found = TopExp_Explorer(shape, TopAbs_FACE), []
    while explorer.More() and names:
        found.append(explorer.Current())
        explorer.Next()
    if len(found) != len(names):
        raise ValueError(f"{len(names)} names for {len(found)} faces; give one for each, in the order of Faces()")
    for name in names:
        if not (name.isascii() and name.isprintable() and "\\" not in name):
            raise ValueError(f"{name!r} is no name for a face; write it in plain letters, such as 'rim'")
    return list(zip(names, found, strict=True))


def _say_material(found: TDocStd_Document, label: TDF_Label, part: Part) -> None:
    texts = (part.material, part.material, "density measure", "POSITIVE_RATIO_MEASURE")
    name, description, measure, kind = (TCollection_HAsciiString(part21_string(text)) for text in texts)
    materials = XCAFDoc_DocumentTool.MaterialTool_s(found.Main())
    materials.SetMaterial(label, name, description, part.density or 0.0, measure, kind)


def _say_profile(found: TDocStd_Document, name: str, faces: Sequence[TDF_Label], width: float) -> None:
    """A profile tolerance of a surface, without a datum: a zone of this width (mm) about the surface as written.

    A plane front in the plane of a flange is one face with that and has no profile of its own.
    """
    if not faces and name == "front":
        return
    if not faces:
        raise ValueError(f"a surface profile is that of the face {name!r}, and none is called so; name the faces")
    tools, toleranced = XCAFDoc_DocumentTool.DimTolTool_s(found.Main()), TDF_LabelSequence()
    for face in faces:
        toleranced.Append(face)
    label, stated = tools.AddGeomTolerance(), XCAFDimTolObjects_GeomToleranceObject()
    stated.SetType(Kind.XCAFDimTolObjects_GeomToleranceType_ProfileOfSurface)
    stated.SetValue(width)
    XCAFDoc_GeomTolerance.Set_s(label).SetObject(stated)
    tools.SetGeomTolerance(toleranced, label)


def part21_string(name: str) -> str:
    r"""Part 21 is ASCII: any other character, and the backslash, becomes \X2\, its hex digits in UTF-16, \X0\."""

    def escape(c: str) -> str:
        return c if " " <= c <= "~" and c != "\\" else "\\X2\\" + c.encode("utf-16-be").hex().upper() + "\\X0\\"

    return "".join(map(escape, name))
