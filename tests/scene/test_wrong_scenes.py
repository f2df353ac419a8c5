"""Wrong scenes: each is refused in one sentence, of which the table has the beginning (a pattern)."""

from __future__ import annotations

from pathlib import Path

import pytest

from bstcad.scene.errors import SceneError
from bstcad.scene.scene import load

TEMPLATES = Path(__file__).parent.parent.parent / "templates"
RGB = "[[486.1, 1.0], [587.6, 2.0], [656.3, 1.0]]"
FLANGE = {"outline": {"shape": "circle", "diameter": 40.0}, "z": 15.5, "thickness": 1.0}
BOX = {"shape": "rectangle", "width": 40.0, "height": 40.0}
SPHERE = {"lens.front.kind": "sphere", "lens.front.curvature": 0.14}
ROUND = SPHERE | {"lens.outline": {"shape": "circle", "radius": 4.5}}
SQUARE = SPHERE | {"lens.outline": {**BOX, "width": 9.0, "height": 9.0}, "lens.front.curvature": 0.02}
PLANE = {"kind": "plane", "z": 40.0}
ZERNIKE = {"kind": "zernike", "z": 40.0, "radius": 10.0, "coefficients": [0.0]}


def flange(changed):
    return {"flange": FLANGE | changed}


# fmt: off
WRONG = {
    "thu": [
        ({"target.pixel": 3}, "target.pixel: unknown key; did you mean 'pixels'"),
        ({"target.kind": "'wall'"}, r"target.kind: 'wall' is not possible; choose one of plane, intensity"),
        ({"target.kind": "'intensity'"}, r"target.x: 400 degrees is not between -180 and 180 degrees"),
        ({"source.aperture": '{shape="oval"}'}, "source.aperture.shape: must be"),
        ({"source.aperture": '{shape="circle"}'}, "source.aperture.radius: missing; add for example radius = 12.0"),
        ({"lens.outline": "3"}, "lens.outline: 3 is not a table; write for example outline = "),
        ({"lens.outline": '{shape="circle",radius=2,diameter=4}'}, "lens.outline: has both radius and diameter"),
        ({"lens.outline.width": '"24"'}, "lens.outline.width: '24' is not a number"),
        ({"target.pixels": "64.5"}, "target.pixels: 64.5 is not a whole number"),
        ({"target.pixels": "[64, 32, 16]"}, "target.pixels: has 3 values"),
        ({"target.x": "[0]"}, "target.x: the list has too few numbers"),
        ({"target.x": "[400, 0]"}, r"target.x: \[400, 0\] is not an interval"),
        ({"target.z": "nan"}, "target.z: nan is not a finite number"),
        ({"title": "2020-01-01"}, "title: 2020-01-01 is a date"),
        ({"target.uniform": "false"}, "target.uniform: false is not possible; write uniform = true"),
        ({"target.gamma": "2.2"}, "target.gamma: only an image or a sample has a gamma"),
        ({"target.text": " "}, "target.text: must have 1 to 100 letters"),
        ({"target.image": "me.png"}, "target.image: .*me.png' not found; give a path relative to the scene file"),
        ({"target.image": "thu.toml"}, "target.image: 'thu.toml' is not a PNG, JPEG, TIFF, WebP, BMP, GIF, HEIC"),
        ({"target.outline": '{shape="circle",radius=201}'}, "target.outline: is larger than the target along x"),
        ({"name": "../.."}, "name: '../..' cannot be"),
        ({"lens.material": "PNMA"}, "lens.material: 'PNMA' is not a known material; did you mean 'PMMA'"),
        ({"lens.encapsulant": "1.41"}, "lens.encapsulant: parallel light comes through air"),
        ({"source.wavelength": "2000"}, "lens.material: the index of PMMA is known from 404.7 to 1083 nm"),
        ({"lens.material": "main/Ag/Johnson"},
         "lens.material: the index of main/Ag/Johnson at source.wavelength is 0.052.* not between 1.01 and 5"),
        ({"source.wavelength": "0.65"}, "source.wavelength: 0.65 nm .* did you mean 650 nm"),
        ({"source.profile": "gaussian"}, "source.radius_1e2: missing, and a gaussian profile needs it"),
        ({"source.radius_1e2": "3"}, "source.radius_1e2: .* uniform profile"),
        ({"lens.front": '{kind="sphere",z=8,curvature=-0.1}'},
         "lens.front.curvature: a sphere of radius 10 mm .* or give lens.front an outline"),
        ({"lens.front": '{kind="sphere",z=8,curvature=-0.1,outline={diameter=24}}'},
         "lens.front.outline.diameter: 24 mm .* 24 mm wide; make it smaller"),
        ({"lens.front": '{kind="sphere",z=8,curvature=-0.1,outline={diameter=19.8}}'},
         "lens.front.outline.diameter: the sphere has a slope of 81.9 degrees .* 80 is the maximum"),
        ({"lens.front": '{kind="sphere",z=8,curvature=-0.1,outline={diameter=22}}'},
         "lens.front.outline.diameter: the sphere does not reach .* 11 mm"),
        ({"lens.front": '{kind="sphere",z=8,curvature=0,outline={diameter=22}}'},
         "lens.front.outline: a front of curvature 0 1/mm is too flat"),
        ({"lens.front": '{kind="sphere",z=8,curvature=0.01,optimise=true,outline={diameter=22}}'},
         "lens.front.optimise: a front with an outline of its own"),
        ({"lens.front": '{kind="sphere",z=8,curvature=0.01,outline={shape="rectangle",width=3,height=3}}'},
         'lens.front.outline.shape: must be "circle"'),
        ({"lens.tool_radius": "0"}, "lens.tool_radius: 0 mm is not between 1e-06 and 1000000000 mm; choose a value in"),
        ({"lens.back.z": "3"}, "lens.back.z: the lens is -5 mm thick at its centre"),
        ({"lens.back.z": "8.4"}, "lens.back.z: .* lens.min_thickness is 0.5 mm; .* z = 8.5"),
        ({"output.mesh_tolerance": "2e-6"}, "output.mesh_tolerance: 2e-06 mm .* STL rounds coordinates of 20 mm"),
        ({"lens.mould": "true"}, "lens.mould: .* lens.tool_radius; add"),
        ({"lens.tool_radius": "1", "tailoring.quality": "paper"}, "lens.tool_radius: the paper's procedure has no"),
        ({"tolerances.rrmsd": "0.1"}, r"tolerances.rrmsd: this table is now called \[accept\]; write accept.rrmsd"),
        ({"lens.max_thickness": "3", "lens.edge_thickness": "4"}, "lens.max_thickness: 3 mm .* 4 mm"),
        ({"lens.max_thickness": "2", "lens.front": '{kind="sphere",z=8,curvature=0.03}'},
         "lens.max_thickness: 2 mm .* 0.5 mm at its thinnest"),
        ({"lens.front": '{kind="sphere",z=8,curvature=0.0585}'}, "lens.back.z: .* thick at its rim"),
        ({"lens.front": '{kind="sphere",z=8,curvature=-0.05}', "source.z": "0"},
         "source.z: the light starts at z = 0, not before"),
        ({"target.z": "20"}, "target.z: the target at z = 20 is not behind the lens"),
        ({"target.tilt": "[0, -78]"}, "target.tilt: seen from the lens, the target is edge-on"),
        ({"target.tilt": "[0, 45]", "target.x": "[-20, 20]", "target.y": "[-20, 20]", "target.z": "30"},
         "target.tilt: the plane of the target cuts the lens; tilt it less"),
        ({"target.tilt": "[0, 20]", "target.x": "[0, 600]", "target.z": "100"},
         "target.tilt: an edge of the target is at z = -2.606.* back of the lens at z = 20"),
        ({"tailoring.method": "adam", "tailoring.accuracy": "0.1"}, "tailoring.accuracy: the paper's procedure"),
        ({"tailoring.method": "integration", "tailoring.max_time": "60"},
         "tailoring.max_time: point-by-point integration"),
        ({"tailoring.method": "integration", "lens.tool_radius": "0.5"},
         "lens.tool_radius: point-by-point integration has no such bounds"),
        ({"tailoring.levels": "[33, 129]"}, "tailoring.levels: must end with lens.back.control_points, 513"),
        ({"tailoring.levels": "[129, 33, 513]"}, r"tailoring.levels: \[129, 33, 513\] does not increase"),
        ({"effects": '[{kind="scatter"}]'}, r"effects\[0\].kind: 'scatter' is not possible; scattering is not built"),
        ({"effects": '[{kind="fresnel",coating={index=1.38}}]'}, r"effects\[0\].coating.thickness: missing; add for"),
        ({"effects": '[{kind="fresnel",metal="Al"}]'}, r"effects\[0\].metal: only a mirror"),
        ({"effects": '[{kind="fresnel"},{kind="fresnel"}]'}, r"effects\[1\]: 'fresnel' is named twice"),
        ({"tolerance": '[{name="lens.tlit",limit=0.1}]'},
         r"tolerance\[0\].name: 'lens.tlit' .*; did you mean 'lens.tilt"),
        ({"tolerance": '[{name="lens.tilt",limit=1,grade="precise"}]'}, r"tolerance\[0\]: has both a limit and a"),
        ({"tolerance": '[{grade="precise"},{limit=0.1}]'}, r"tolerance\[1\].limit: 0.1 needs the name"),
        ({"tolerance": '[{name="lens.tilt"}]'}, r"tolerance\[0\]: the table has no setting"),
        ({"tolerance": '[{name="lens.tilt",period=1.0}]'}, r"tolerance\[0\].period: this key is for back.ripple"),
        ({"tolerance": '[{name="back.form",distribution="uniform"}]'}, r"tolerance\[0\].distribution: a form error is"),
        ({"effects": '[{kind="absorption"}]', "lens.index": "1.5"}, r"effects\[0\].coefficient: missing, and"),
        ({"lens.back.reflect": "true"}, r"lens.material: light does not enter a mirror \(lens.back.reflect\)"),
        ({"source.wavelength": "[]"}, "source.wavelength: the list is empty; give one wavelength"),
        ({"source.wavelength": "[[486.1, -1.0]]"}, "source.wavelength: the weight -1 of the line at 486.1 nm is not"),
        ({"source.wavelength": "[486.1, 587.6]"}, "source.wavelength: a spectrum is a list of lines"),
        ({"source.wavelength": "[[486.1, 1], [2000, 1]]"}, "lens.material: .* PMMA .*nm"),
        ({"source.wavelength": RGB, "lens.index": "1.5"}, "lens.index: one index is not valid for the 3 lines"),
        ({"source.divergence": "90", "source.tilt": "[50, 0]"}, r"source.divergence: .* 89 degrees"),
        ({"source.tilt": "[91, 0]"}, r"source.tilt: .* 89 degrees"),
        ({"source.tilt": "[10, 0]", "source.z": "-500"}, "source.tilt: no light reaches the lens; tilt"),
        ({"source.centre": "[100, 0]"}, "source.centre: no light reaches the lens; tilt or move"),
        ({"wavefront": PLANE | {"z": 20.0}},
         "wavefront.z: the plane at z = 20 mm is not behind the back at 20 mm; move it further along"),
        ({"wavefront": PLANE | {"direction": [1.0, 0.0, 0.0]}}, "wavefront.direction: "),
        ({"wavefront": PLANE | {"direction": [0.0, 0.0, 0.0]}}, "wavefront.direction: "),
        ({"wavefront": PLANE, "source.divergence": 0.5},
         r"wavefront: .* \(source.divergence\) has no single wavefront; make it parallel"),
        ({"wavefront": PLANE | {"kind": "sphere", "focus": [5.0, 0.0, 40.0]}},
         "wavefront.focus: .* z = 40 mm; "),
        ({"wavefront": ZERNIKE | {"coefficients": []}}, "wavefront.coefficients: "),
        ({"wavefront": ZERNIKE | {"coefficients": [0.0, 9e4]}},
         "wavefront.coefficients: the wave is too steep to have rays; make them smaller, or the radius larger"),
        ({"accept.wavefront": 0.1}, r"accept.wavefront: the scene has no \[wavefront\]"),
    ],
    "disk": [
        ({"lens.outline": {"shape": "circle", "radius": 8.0}, "lens.back.control_points": 5},
         "lens.back.control_points: 5 is too few for a round lens, .*; give 6 or more"),
        ({"source.diameter": "15.1"}, "source.diameter: 15.1 mm is more than the 15 mm from the source to the lens"),
        ({"source.width": "1"}, "source.height: the key is missing; add it in mm"),
        ({"source.diameter": "1", "source.width": "1"}, "source.diameter: the source also has a width; give a"),
        ({"source.tilt": "[180, 0]"}, "source.tilt: no light reaches the lens; tilt"),
        ({"lens.front": '{ kind = "sphere", z = 15.0, curvature = -0.05 }',
          "source": '{ kind = "point", position = [0.0, 0.0, 8.6], diameter = 6.0, tilt = [0.0, 80.0] }'},
         "source.position: the light starts at z = 11.55.*, not before the front at z = 11.49"),
        ({"lens.front": "{z=5,kind='conic',curvature=0.09}"}, "lens.front.curvature: a conic .* too steep"),
        ({"lens.front": "{z=5,kind='conic',curvature=-0.09,conic_constant=-40}"},
         "lens.front.conic_constant: .* nearly a cone"),
        ({"lens.front": "{z=5,kind='conic',optimise=['conic_constant']}"}, "lens.front.optimise: a front of"),
        ({"lens.front": "{z=5,kind='sphere',optimise=['conic_constant']}"},
         r"lens.front.optimise\[0\]: .* not possible"),
        ({"lens.front": "{z=5,kind='bspline',file='gone'}"}, "lens.front.file: '.*gone' not found; give the folder"),
        ({"lens.front": "{z=5,kind='bspline',file='disk.toml'}"}, r"lens.front.file: .* cannot be read \(.*\); give"),
        ({"mount": {"datum": "flange"}}, 'mount.datum: "flange" needs'),
        ({"mount": {"rim": {"shape": "circle", "diameter": 17.0}}}, "mount.rim: extends past lens.outline"),
        ({"mount": {"rim": {"shape": "rectangle", "width": 8.0, "height": 6.0, "corner_radius": 3.0}}},
         "mount.rim.corner_radius: 3 mm is not less than 3 mm"),
        ({"mount": flange({"outline": {"shape": "circle", "diameter": 22.0}})}, "mount.flange.outline: must extend"),
        ({"mount": flange({"z": 30.0})}, "mount.flange.z: the flange is from z = 30 to 31 mm"),
        ({"mount": flange({"outline": BOX | {"corner_radius": 0.3}, "bevel": 0.3})},
         "mount.flange.outline.corner_radius: 0.3 mm .* draft and bevel remove 0.3 mm"),
        ({"mount": flange({"bevel": 0.5})}, "mount.flange.bevel: two bevels of 0.5 mm .* 1 mm thick"),
        ({"mount": flange({"holes": [[19.0, 0.0, 2.0]]})}, "hole 1, of 2 mm at .19, 0. mm, .* from the flange"),
        ({"mount": flange({"holes": [[9.0, 0.0, 2.0]]})}, "hole 1, of 2 mm at .9, 0. mm, .* from the lens"),
        ({"mount": flange({"holes": [[14.0, 0.0, 2.0], [14.0, 1.0, 2.0]]})}, "hole 2, .* from hole 1; move one"),
        ({"mount": flange({"holes": [[14.0, 0.0, 0.0]]})}, "hole 1, .* has no width"),
        ({"mount": flange({"screws": {"count": 40, "diameter": 3.2, "circle": 34.0}})}, "from hole 1; move one"),
        ({"mount": {"bevel": 5.0}}, "mount.bevel: 5 mm .* a wall of 5 mm"),
        ({"mount": flange({"z": 14.9}) | {"draft": 1.0}}, "mount.draft: no wall is left below the flange"),
        ({"mount": {"rim": {"shape": "rectangle", "width": 8.0, "height": 6.0, "corner_radius": 0.5},
                    "draft": 5.0, "bevel": 0.1}},
         "mount.rim.corner_radius: 0.5 mm .* draft and bevel remove 0.537 mm"),
        ({"mount": {"rim": {"shape": "circle", "diameter": 5.0}, "draft": 29.0}},
         "mount.draft: draft and bevel remove 2.77 mm"),
        (SQUARE | {"mount": flange({"z": 15.3})}, "mount.flange.z: .* z = 15.3 mm, cuts the rim of the front"),
        (ROUND | {"mount": flange({"z": 15.1})}, "mount.flange.z: .* z = 15.1 to 16.1 mm.* from 16.5957 to 20 mm"),
        (ROUND | {"mount": {"bevel": 0.2}}, "mount.bevel: .* 0.811 mm per mm, too"),
        ({"part.colour": "blue"}, "part.colour: 'blue' is not a colour"),
        ({"part.author": ""}, "part.author: must be one line of 1 to 200"),
        ({"part.thickness_tolerance": 5.0}, "part.thickness_tolerance: 5 mm .* thickness of the blank, 5 mm"),
        ({"part.date": "6 May 2031"}, 'part.date: \'6 May 2031\' .* ISO 8601; write it as "2031-05-06"'),
        ({"lens.index": 1.5, "part.density": 1.2}, "part.density: .*; add part.material"),
        ({"part.schema": "AP214", "part.surface_profile": 0.005}, "part.surface_profile: AP214"),
    ],
    "mirror": [
        ({"lens.index": "1.5"}, "lens.index: light does not enter a mirror"),
        ({"source.position": "[0, 0, 20]"}, "source.position: the light starts at z = 20, not above the mirror at z"),
        ({"source": '{kind="collimated",aperture={shape="circle",radius=9}}'}, "source.z: missing, and a mirror"),
        ({"lens.front": '{kind="sphere",z=0,optimise=true}'}, "lens.front.optimise: no light meets the front"),
        ({"effects": '[{kind="absorption"}]'}, r"effects\[0\]: a mirror .* has no absorption"),
        ({"effects": '[{kind="fresnel",coating={index=1.38,thickness=100.0}}]'}, r"effects\[0\].coating: the face"),
        ({"target.z": "19"}, "target.z: the target at z = 19 is not above the mirror, whose face is at z = 20; move"),
        ({"source.tilt": "[0, 60]"}, "source.tilt: no light reaches the mirror"),
    ],
}
# fmt: on
CASES = [(name, *case) for name, cases in WRONG.items() for case in cases]


@pytest.mark.parametrize(("name", "overrides", "sentence"), CASES, ids=[f"{name}: {case}" for name, _, case in CASES])
def test_a_wrong_scene_is_one_sentence(name, overrides, sentence):
    with pytest.raises(SceneError, match=sentence) as caught:
        load(TEMPLATES / f"{name}.toml", overrides)
    text = str(caught.value)
    assert "\n" not in text and "pydantic" not in text
    assert "; " in text or "did you mean" in text  # the fault; the remedy
