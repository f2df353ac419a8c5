"""Placements in text written by hand, each with the motion that ISO 10303-42 gives it."""

from __future__ import annotations

import numpy as np
import pytest

from bstcad.step_text import part21
from bstcad.step_text.placement import Placement, own_frame
from tests.step_text.test_part21 import NET, SIMPLE, square, text

X, Y, Z = np.eye(3)
AXES = """#100 = CARTESIAN_POINT('',(0.,0.,0.)); #101 = CARTESIAN_POINT('',(1.,2.,3.)); #103 = DIRECTION('',(0.,2.,0.));
#102 = DIRECTION('',(0.,0.,5.)); #110 = AXIS2_PLACEMENT_3D('',#100,$,$); #104 = DIRECTION('',(1.,0.,7.));
#111 = AXIS2_PLACEMENT_3D('',#101,#102,#103);
#120 = SHAPE_REPRESENTATION('',(#111),#900);
"""
PART = "#121 = ADVANCED_BREP_SHAPE_REPRESENTATION('',(#110,#90),#900);\n"
PRODUCTS = """#130 = SHAPE_DEFINITION_REPRESENTATION(#131,#121); #131 = PRODUCT_DEFINITION_SHAPE('','',#132);
#132 = PRODUCT_DEFINITION('','',$,$); #133 = PRODUCT_DEFINITION('','',$,$);
#134 = NEXT_ASSEMBLY_USAGE_OCCURRENCE('1','','',#133,#132,$); #135 = PRODUCT_DEFINITION_SHAPE('','',#134);
#136 = CONTEXT_DEPENDENT_SHAPE_REPRESENTATION(#140,#135);
"""
RELATED = """#140 = ( REPRESENTATION_RELATIONSHIP('',$,#121,#120) REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION(#141)
 SHAPE_REPRESENTATION_RELATIONSHIP() ); #141 = ITEM_DEFINED_TRANSFORMATION('','',#110,#111);
"""
ASSEMBLY = AXES + PART + PRODUCTS + RELATED
MAPPED = AXES.replace("(#111),#900", "(#150),#900") + PART + """#150 = MAPPED_ITEM('',#151,#111);
#151 = REPRESENTATION_MAP(#110,#121);
"""  # fmt: skip
SAME = """#160 = SHAPE_REPRESENTATION('',(#110),#900); #161 = SHAPE_REPRESENTATION_RELATIONSHIP('','',#160,#121);
"""
MOVED = Placement(np.stack([Y, -X, Z], axis=1), np.array([1.0, 2.0, 3.0]))  # x of the part is y of the whole

STATED = {
    "assembly": (ASSEMBLY, MOVED),
    "mapped": (MAPPED, MOVED),
    "not placed": (AXES + PART, Placement(np.eye(3), np.zeros(3))),
    "axes exchanged": (ASSEMBLY.replace("#110,#111);", "#111,#110);"), MOVED),
    "relationship reversed": (
        ASSEMBLY.replace("#121,#120)", "#120,#121)").replace("#110,#111);", "#111,#110);"), MOVED,
    ),
    "by another representation": (
        ASSEMBLY.replace("$,#121,#120)", "$,#160,#120)").replace("#131,#121)", "#131,#160)") + SAME, MOVED,
    ),
    "reference direction not across": (
        ASSEMBLY.replace("#102,#103", "#102,#104"), Placement(np.eye(3), np.array([1.0, 2.0, 3.0])),
    ),
    "no reference direction": (
        ASSEMBLY.replace("#102,#103", "#102,$"), Placement(np.eye(3), np.array([1.0, 2.0, 3.0])),
    ),
    "an operator": (
        MAPPED.replace("#151,#111", "#151,#152")
        + "#152 = CARTESIAN_TRANSFORMATION_OPERATOR_3D('','',#103,$,#101,1.,#102);\n", MOVED,
    ),
}  # fmt: skip


@pytest.mark.parametrize("how", STATED)
def test_a_placement_is_applied_as_it_is_stated(how):
    statements, expected = STATED[how]
    found = part21.parse(text(SIMPLE + square() + statements))
    assert np.array_equal(found.placement.rotation, expected.rotation)
    assert np.array_equal(found.placement.shift, expected.shift)
    assert np.array_equal(found.surface.control_points, NET @ expected.rotation.T + expected.shift)


def test_nested_placements_follow_each_other():
    outer = """#170 = SHAPE_REPRESENTATION('',(#171),#900); #171 = MAPPED_ITEM('',#172,#173);
#172 = REPRESENTATION_MAP(#110,#120); #173 = AXIS2_PLACEMENT_3D('',#101,#105,#102); #105 = DIRECTION('',(1.,0.,0.));
"""
    found = part21.parse(text(SIMPLE + square() + ASSEMBLY + outer)).placement
    whole = Placement(np.stack([Z, np.cross(X, Z), X], axis=1), np.array([1.0, 2.0, 3.0]))
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert np.array_equal(found(points), whole(MOVED(points)))


def test_the_centroid_of_an_assembly_is_not_that_of_its_part():
    """Both are stated, each in its own frame; area and volume are alike."""
    stated = "".join(
        f"#{n}0 = PROPERTY_DEFINITION_REPRESENTATION(#{n}1,#{n}2); #{n}1 = PROPERTY_DEFINITION('geometric validation "
        f"property','centroid',{shape}); #{n}2 = SHAPE_REPRESENTATION('centroid',(#{n}3),#900);\n"
        f"#{n}3 = CARTESIAN_POINT('centre point',({n}.,0.,0.));\n"
        for n, shape in ((20, "#131"), (21, "#137"), (22, "#135"))
    ) + "#137 = PRODUCT_DEFINITION_SHAPE('','',#133);\n"  # fmt: skip
    assert part21.parse(text(SIMPLE + square() + ASSEMBLY + stated)).properties.centroids == ((20.0, 0.0, 0.0),)


REFUSED = {
    "scaled": (STATED["an operator"][0].replace("1.,#102", "2.,#102"), "it scales the lens by 2"),
    "ambiguous": (ASSEMBLY.replace("#102,#103", "#103,$"), "no reference direction"),
    "parallel": (ASSEMBLY.replace("#102,#103", "#102,#102"), "are parallel"),
    "no length": (ASSEMBLY.replace("(0.,0.,5.)", "(0.,0.,0.)"), "has no length"),
    "twice": (MAPPED.replace("(#150)", "(#150,#153)") + "#153 = MAPPED_ITEM('',#151,#110);\n", "more than once"),
    "of itself": (MAPPED.replace("(#110,#90)", "(#110,#90,#153)") + """#153 = MAPPED_ITEM('',#154,#110);
#154 = REPRESENTATION_MAP(#110,#120);\n""", "part of itself"),
    "in a plane": (ASSEMBLY.replace("AXIS2_PLACEMENT_3D('',#101,#102,#103)", "AXIS2_PLACEMENT_2D('',#101,#103)"),
                   "AXIS2_PLACEMENT_2D is a placement"),
}  # fmt: skip


@pytest.mark.parametrize("how", REFUSED)
def test_what_is_no_placement_of_a_lens_is_refused(how):
    statements, sentence = REFUSED[how]
    with pytest.raises(ValueError, match=sentence) as caught:
        part21.parse(text(SIMPLE + square() + statements))
    assert "\n" not in str(caught.value)


def test_a_net_tells_its_own_frame_to_rounding():
    """Turned and moved at random, it comes back within 1e-10 mm; a net with one point off its grid is not moved.

    Waves of 1e-3 mm tell the axis, coordinates are rounded by 1e-14 mm.
    """
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.linspace(-12, 12, 9), np.linspace(-10, 10, 7), indexing="ij")
    net = np.stack([x, y, 20 + 0.05 * x + 1e-3 * rng.normal(size=x.shape)], axis=-1)
    assert not own_frame(net).moves
    for _ in range(20):
        made = Placement.of_axes(rng.normal(size=3) * 30, rng.normal(size=3), rng.normal(size=3))
        found = own_frame(made(net))
        assert np.abs(found.rotation - made.rotation).max() < 1e-11
        back = found.inverse(made(net)) - net
        assert np.abs(back[..., :2]).max() < 1e-11 and np.ptp(back[..., 2]) < 1e-10
    net[2, 3, 0] += 1e-6
    assert not own_frame(net).moves
