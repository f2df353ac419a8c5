"""Lenses, sources and screens by which programs not written here are compared with bstcad."""

from dataclasses import replace

import torch

from bstcad.optics.lens import passes
from bstcad.optics.light.collimated import CollimatedSource
from bstcad.optics.light.point import PointSource
from bstcad.optics.receivers.irradiance import Screen
from bstcad.optics.surfaces.outlines import Circle, Rectangle, Rounded
from bstcad.optics.surfaces.surfaces import Plane, Sphere
from tests.lenses import SQUARE, lens_of, net


def waved(z=20.0, m=33, ripple=0.05, phase=0.5):
    """A back that no symmetry maps onto itself."""
    return net(
        lambda x, y: -0.002 * (x**2 + 1.3 * y**2) - ripple * torch.sin(0.2 * x + phase) * torch.cos(0.3 * y), z, m
    )


def lens(front=None, outline=SQUARE, **more):
    return lens_of(waved(), front or Sphere(12.0, -0.01), outline, 1.49, **more)


MIRROR = lens(Plane(0.0), passes=passes.MIRROR)
SCREEN = Screen(400.0, (-30.0, 30.0), (-20.0, 20.0), (48, 32))
TILTED = replace(SCREEN, x=(-48.0, -34.0), y=(-34.0, -20.0), pixels=32, tilt=(20.0, -15.0))
WIDE = replace(SCREEN, x=(-120.0, 90.0), y=(-90.0, 110.0))
BEAM = CollimatedSource(Rectangle(18.0, 16.0))
TILTED_BEAM = CollimatedSource(Circle(9.0), tilt=(4.0, -6.0), centre=(0.5, -0.3), z=5.0)
LAMP = PointSource((1.0, -0.5, -20.0), profile="gaussian", half_angle_1e2=14.0)
CONE = PointSource((0.5, 1.0, 90.0), profile="uniform", half_angle=5.0)
APERTURES = Rounded(14.0, 13.0, corner_radius=3.0), Rounded(15.0, 16.0, corner_radius=4.0)
CASES = {
    "a beam": (lens(), BEAM, SCREEN),
    "a tilted beam, a round lens, a tilted screen": (lens(Plane(12.0), Circle(8.5)), TILTED_BEAM, TILTED),
    "a gaussian point, a round lens": (lens(outline=Circle(8.5)), LAMP, WIDE),
    "a gaussian point, clear apertures": (lens(clear=APERTURES), LAMP, WIDE),
    "a mirror": (MIRROR, CONE, replace(SCREEN, x=(-54.0, 60.0), y=(-56.0, 66.0))),
}
