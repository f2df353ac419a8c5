"""A made part: a lens with a known form error, and clouds of it as an instrument would give them."""

from dataclasses import replace

import numpy as np
import scipy.fft
import torch
from scipy.spatial.transform import Rotation

from bstcad.manufacture.measured.alignment import BackFace
from bstcad.manufacture.measured.form_error import frequencies
from bstcad.optics.surfaces.surfaces import sag, sampled

SHIFT, TURN = (0.5, -0.3, 0.2), (1.0, -2.0, 3.0)  # mm, degrees


def with_form_error(lens, rms, correlation, seed=1):
    """The lens with a random form error of so many mm RMS and a Gaussian spectrum, correlated over so many mm.

    It holds no motion: the part of it that a shift or a turn of the face could take up is taken off.
    """
    back, m = lens.back, lens.back.m
    amplitude = np.exp(-((np.pi * frequencies(back) * correlation) ** 2) / 2)
    heights = scipy.fft.idctn(np.random.default_rng(seed).normal(size=amplitude.shape) * amplitude, norm="ortho")
    x, y = (t.ravel() for t in np.meshgrid(np.linspace(*back.x, m), np.linspace(*back.y, m), indexing="ij"))
    z, z_x, z_y = sampled(back, x, y)
    motions = BackFace.of(lens).columns(np.stack([x, y, z], axis=1), np.stack([-z_x, -z_y, np.ones_like(z)], axis=1))
    motions = motions.T.reshape(6, m, m)
    error, *moved = (_over(lens, part) for part in (heights, *motions))
    heights = heights - np.tensordot(np.linalg.lstsq(np.stack(moved, axis=1), error, rcond=None)[0], motions, axes=1)
    heights *= rms / _over(lens, heights).std()
    return lens.with_back(replace(back, heights=back.heights + torch.from_numpy(heights)))


def _over(lens, heights):
    """A form error at 20 000 places over the outline."""
    return points(lens.with_back(replace(lens.back, z=0.0, heights=torch.from_numpy(heights))), 20_000)[:, 2]


def points(lens, count, seed=2):
    """(count, 3) points of the back face, spread over the outline at random (mm)."""
    places = np.random.default_rng(seed).uniform(-1, 1, (2 * count, 2)) * lens.outline.half_extent
    inside = lens.outline.contains(*torch.from_numpy(places).T).numpy()
    x, y = places[inside][:count].T
    return np.column_stack([x, y, sag(lens.back, x, y)])


def cloud(lens, count, noise=0.0, shift=SHIFT, turn=TURN):
    """Points of the back face as an instrument sees them that holds the lens otherwise; noise: along z, RMS (mm)."""
    found, pivot = points(lens, count), BackFace.of(lens).pivot
    found[:, 2] += np.random.default_rng(3).normal(0.0, 1.0, len(found)) * noise
    return (found - pivot) @ Rotation.from_rotvec(np.radians(turn)).as_matrix().T + pivot + shift


def dirty(found, share, sides, heights="even", seed=5):
    """(the cloud with that share of its points off along z, which ones): 0.02 to 0.5 mm, all 0.05 mm, or mostly small.

    sides: (1,) for dust, (-1, 1) for slips of an instrument.
    """
    random, n = np.random.default_rng(seed), len(found)
    which = random.permutation(n)[: max(1, round(share * n))]
    size = {
        "even": random.uniform(0.02, 0.5, len(which)), "alike": np.full(len(which), 0.05),
        "small": 0.02 * random.exponential(size=len(which)),
    }[heights]  # fmt: skip
    off = np.zeros(n)
    off[which] = size * random.choice(sides, len(which))
    return found + off[:, None] * [0.0, 0.0, 1.0], off != 0


def low_order(places, kind, size, random):
    """A form error of low order at points, along z: its amplitude is `size` (mm) at the rim, its direction random."""
    turn, (x, y) = random.uniform(0, 2 * np.pi), places[:, :2].T / np.abs(places[:, :2]).max()
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    square = u * u + v * v
    if kind == "random":  # Legendre polynomials of degrees 2 to 5, twice their RMS is `size`
        degrees = np.add(*np.indices((6, 6)))
        factors = random.normal(size=(6, 6)) * ((degrees >= 2) & (degrees <= 5)) / (1 + degrees)
        shape = np.polynomial.legendre.legval2d(x, y, factors)
        return size / 2 * shape / shape.std()
    shapes = {
        "astigmatism": u * u - v * v, "coma": (3 * square - 2) * u, "cylinder": 2 * u * u - 1,
        "spherical": 6 * square**2 - 6 * square + 1, "trefoil": u**3 - 3 * u * v * v,
    }  # fmt: skip
    return size * shapes[kind]
