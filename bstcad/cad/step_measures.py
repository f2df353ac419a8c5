"""The measures of a STEP model, each in its unit: what OCC states wrongly is mended, validation properties are added.

OCC calls the width of a tolerance metres though it is in mm, and a density in g/cm³ one in g³ cm².  It would tie
validation properties to the solid by a second representation of it; here they are properties of the part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from OCP.StepBasic import (
    StepBasic_DerivedUnit,
    StepBasic_DerivedUnitElement,
    StepBasic_HArray1OfDerivedUnitElement,
    StepBasic_MeasureValueMember,
    StepBasic_ProductRelatedProductCategory,
    StepBasic_SiPrefix,
    StepBasic_SiUnitAndLengthUnit,
    StepBasic_SiUnitAndMassUnit,
    StepBasic_SiUnitName,
    StepBasic_Unit,
)
from OCP.StepData import StepData_StepModel
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
from OCP.TCollection import TCollection_HAsciiString as Text

from bstcad.cad.mass_properties import MassProperties

MILLI, METRE = StepBasic_SiPrefix.StepBasic_spMilli, StepBasic_SiUnitName.StepBasic_sunMetre
PER_VOLUME = -3.0  # exponent of the length in a density


def first(model: StepData_StepModel, kind: type) -> Any:
    """The first entity of a kind: of those of the product, which stand before its shape."""
    entities = (model.Value(i) for i in range(1, model.NbEntities() + 1))
    return next(entity for entity in entities if isinstance(entity, kind))


def mend(model: StepData_StepModel) -> None:
    """Let the tolerances be in mm, and a density in g/cm³."""
    for entity in _behind_the_shape(model):
        if isinstance(entity, StepDimTol_GeometricTolerance):
            entity.Magnitude().UnitComponent().NamedUnit().SetPrefix(MILLI)
        elif isinstance(entity, StepBasic_DerivedUnit):  # there is none but the density's
            for element in (entity.ElementsValue(i) for i in range(1, entity.NbElements() + 1)):
                element.SetExponent(1.0 if isinstance(element.Unit(), StepBasic_SiUnitAndMassUnit) else PER_VOLUME)


def _behind_the_shape(model: StepData_StepModel) -> Iterator[Any]:
    """The last entities, back to the product's category, which OCC writes when it has done with the shape."""
    for i in range(model.NbEntities(), 0, -1):
        entity = model.Value(i)
        if isinstance(entity, StepBasic_ProductRelatedProductCategory):
            return
        yield entity


def state(model: StepData_StepModel, properties: MassProperties) -> None:
    """Add area, volume and centroid as geometric validation properties of the part.

    Names as in "Recommended Practices for Geometric and Assembly Validation Properties" of the CAx Interoperability
    Forum.
    """
    part = first(model, StepRepr_ProductDefinitionShape)
    context = first(model, StepShape_ShapeDefinitionRepresentation).UsedRepresentation().ContextOfItems()
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
        definition, stated = StepRepr_PropertyDefinition(), StepRepr_Representation()
        definition.Init(Text("geometric validation property"), True, Text(name), target)
        stated.Init(Text(name), held, context)
        defined.SetValue(definition)
        both = StepRepr_PropertyDefinitionRepresentation()
        both.Init(defined, stated)
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
