"""Points to spline: the rigid motion that brings a cloud onto the face, by Gauss-Newton, never by a mirror image.

Least squares of the signed distances d along the face's normals n, of all points but outliers.  A small motion, a shift
τ and a turn ω about the pivot c, changes the distance of a point q by n · τ + ((q - c) × n) · ω: six columns, written
in mm at the lens's rim so that shifts and turns compare.  Motions that hardly change any distance (the rotation of a
round face about its axis, the shift of a flat one) are not determined and stay zero.

The search starts with a few thousand points, weighted so that those of sides and front do not pull, from several poses;
the best is kept, and the cloud as it was given unless another is clearly better.  Only proper motions are tried.  A
cloud that fits once its axes are exchanged or reversed is a fault, to be named.

Outliers are isolated points by dust, glints and slips of an instrument, as against form errors, which cover an area.  A
point is compared with the plane through its nearest neighbours.  It is an outlier if it lies farther from that plane
than noise and form error explain, and too few neighbours lie beside it: pits, bumps and edges of more points are form.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import permutations, product

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bstcad.analysis import shape
from bstcad.measured.cloud import FEWEST
from bstcad.optics.lens import Lens
from bstcad.optics.surfaces import Surface

STEPS = 30  # of Gauss-Newton, at most
LOOKS = 6  # rounds of a search for outliers, at most
ENOUGH = 1e-10  # mm at the rim: the last step is smaller
FOOT_STEPS = 3  # towards the foot of a perpendicular; each leaves (distance x curvature) of the error before
INDEPENDENT = 100  # patches of a face with independent form errors
PATCHES = 16  # patches of a face with independent form errors that resemble a change of scale
LOOSE = 0.1  # of the lens's half width: a motion of that uncertainty by form errors is not determined
FLAT = 1e-7  # mm of distance for each mm of motion: less is rounding
RIM = 2e-3  # of the half width: nearer to the outline a point may lie on the edge
OFF_FACE = 0.25  # of the smallest thickness: farther points belong to the front, the sides or a fixture
NAMES = ("shift in x", "shift in y", "shift in z", "rotation about x", "rotation about y", "rotation about z")


def root_mean_square(values: np.ndarray) -> float:
    """sqrt(mean of squares)."""
    return float(np.sqrt(np.mean(values * values)))


def sampled(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3, n) z (mm), ∂z/∂x and ∂z/∂y of a surface at (x, y) in mm."""
    return np.stack(
        [p.numpy() for p in surface.sag_and_slope(*map(torch.from_numpy, map(np.ascontiguousarray, (x, y))))]
    )


@dataclass(frozen=True)
class Face:
    """The back face of a lens as points are held to it."""

    lens: Lens
    pivot: np.ndarray  # (3,) mm, on the face's axis: rotations are about it
    reach: float  # half of the larger side (mm)
    near: float  # mm: farther points are not of the face

    @classmethod
    def of(cls, lens: Lens) -> Face:
        """The back of `lens`."""
        x, y = shape.inside(lens.outline, 65)
        front, back = (sampled(surface, x.numpy(), y.numpy())[0] for surface in (lens.front, lens.back))
        vertex, _, _ = sampled(lens.back, *np.zeros((2, 1)))
        near = OFF_FACE * float((back - front).min())
        return cls(lens, np.array([0.0, 0.0, float(vertex[0])]), max(lens.outline.half_extent), near)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """True for points over the outline, but for its very rim."""
        return self.lens.outline.contains(*torch.from_numpy(points[:, :2].T * (1 + RIM))).numpy()

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(signed distance (n,) in mm, + out of the glass; normal (n, 3) there), from the foot of the perpendicular."""
        foot = points[:, :2]
        for _ in range(FOOT_STEPS):
            z, z_x, z_y = sampled(self.lens.back, *foot.T)
            length = np.sqrt(1 + z_x * z_x + z_y * z_y)
            normal = np.stack([-z_x / length, -z_y / length, 1 / length], axis=1)
            off = points - np.column_stack([foot, z])
            d = off[:, 0] * normal[:, 0] + off[:, 1] * normal[:, 1] + off[:, 2] / length
            foot = points[:, :2] - d[:, None] * normal[:, :2]
        return d, normal

    def height(self, points: np.ndarray) -> np.ndarray:
        """(n,) heights along z (mm) of points above the face."""
        return points[:, 2] - sampled(self.lens.back, *points[:, :2].T)[0]

    def columns(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(n, 6) change of each distance for a mm of shift in x, y, z, and of rotation about them at the rim."""
        return np.hstack([normals, np.cross(points - self.pivot, normals) / self.reach])


@dataclass(frozen=True)
class Pose:
    """The place of the part in the frame of its cloud: from its place in the design, turned and then shifted.

    A design point p stands in the cloud at R (p - pivot) + pivot + shift.
    """

    rotation: np.ndarray  # R (3, 3), a proper rotation
    shift: np.ndarray  # (3,) mm
    pivot: np.ndarray  # (3,) mm

    def undone(self, points: np.ndarray) -> np.ndarray:
        """The points (n, 3) brought onto the design."""
        return (points - self.pivot - self.shift) @ self.rotation + self.pivot

    def after(self, motion: np.ndarray, reach: float) -> Pose:
        """The pose that undoes this one and then moves the points by `motion`, as Face.columns counts it."""
        turn = Rotation.from_rotvec(motion[3:] / reach).as_matrix()
        rotation = self.rotation @ turn.T
        return Pose(rotation, self.shift - rotation @ motion[:3], self.pivot)

    @property
    def angles(self) -> np.ndarray:
        """(3,) degrees: the rotation vector, its direction the axis, about x, y and z."""
        return np.degrees(Rotation.from_matrix(self.rotation).as_rotvec())


def unmoved(face: Face, shift: np.ndarray | None = None) -> Pose:
    """The pose of a part that lies in its cloud as in its design, but for a shift (mm)."""
    return Pose(np.eye(3), np.zeros(3) if shift is None else shift, face.pivot)


@dataclass(frozen=True)
class Alignment:
    """A cloud on the face."""

    pose: Pose  # removed from the cloud
    points: np.ndarray = field(repr=False)  # (n, 3) mm on the design, those of the face only
    distances: np.ndarray = field(repr=False)  # (n,) mm, signed along the normal
    normals: np.ndarray = field(repr=False)  # (n, 3)
    motions: np.ndarray = field(repr=False)  # (6, k) motions that the face determines, orthonormal
    undetermined: tuple[str, ...]  # the other motions, in words
    outside: int  # points beyond the outline, or on its rim
    off_face: int  # points over the face, but far from it
    outliers: np.ndarray = field(repr=False)  # (k, 3) mm on the design: isolated points near the face

    @property
    def outlier_share(self) -> float:
        """Of the points near the face."""
        return len(self.outliers) / (len(self.outliers) + len(self.points))

    @property
    def rms(self) -> float:
        """Of the distances (mm)."""
        return root_mean_square(self.distances)


def aligned(face: Face, cloud: np.ndarray, start: Pose) -> Alignment:
    """Least squares from a start near enough; all points of the face have one weight, outliers are left out.

    Outliers are searched at the start, and again among the points that lie on the face only after alignment.
    """
    pose, noise = start, None
    judged, out = np.zeros((2, len(cloud)), dtype=bool)
    for _ in range(LOOKS):
        points, inside, near = _chosen(face, cloud[~out], pose)
        chosen = np.flatnonzero(~out)[inside & near]
        if judged[chosen].all():
            break
        alone, noise = isolated(points, face.distance(points)[0], ~judged[chosen], noise)
        if alone.any():  # the rest lies otherwise without them
            judged[:], noise = False, None
        else:
            judged[chosen] = True
        out[chosen] = alone
        pose = _least_squares(face, cloud[~out], pose)
    points, inside, near = _chosen(face, cloud[~out], pose)
    distances, normals = face.distance(points)
    _, motions = step(face, points, distances, normals)
    return Alignment(
        pose, points, distances, normals, motions=motions, undetermined=_undetermined(motions),
        outside=int((~inside).sum()), off_face=int((inside & ~near).sum()), outliers=pose.undone(cloud[out]),
    )  # fmt: skip


def _least_squares(face: Face, cloud: np.ndarray, pose: Pose) -> Pose:
    """The pose by least squares of all points of the face, from a pose near enough."""
    for _ in range(STEPS):
        points, *_ = _chosen(face, cloud, pose)
        motion, _ = step(face, points, *face.distance(points))
        pose = pose.after(motion, face.reach)
        if np.abs(motion).max() < ENOUGH:
            break
    return pose


def step(
    face: Face, points: np.ndarray, distances: np.ndarray, normals: np.ndarray, weight: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(motion (6,), the motions (6, k) that are determined): one step of Gauss-Newton towards zero distances."""
    columns = face.columns(points, normals)
    weight = np.full(len(points), 1 / len(points)) if weight is None else weight / weight.sum()
    weighted = columns * weight[:, None]
    sensitivity2, directions = np.linalg.eigh(columns.T @ weighted)
    spread = np.sqrt(weight @ distances**2)
    known = sensitivity2 > max(FLAT, spread / (np.sqrt(INDEPENDENT) * LOOSE * face.reach)) ** 2
    motions = directions[:, known]
    return -motions @ ((motions.T @ (weighted.T @ distances)) / sensitivity2[known]), motions


def _chosen(face: Face, cloud: np.ndarray, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points of the face; True for points of the cloud inside the outline; True for points near the face)."""
    points = pose.undone(cloud)
    inside, near = face.inside(points), np.abs(face.height(points)) <= face.near
    chosen = points[inside & near]
    if len(chosen) < FEWEST:
        raise ValueError(
            f"{len(chosen)} of its points come to lie on the back face, too few; give a cloud of that face"
        )
    return chosen, inside, near


def _undetermined(motions: np.ndarray) -> tuple[str, ...]:
    """The motions that `motions` (6, k) leave out, in words; each combined motion is one entry."""
    size, directions = np.linalg.eigh(np.eye(len(NAMES)) - motions @ motions.T)
    return tuple(
        " with ".join(name for name, part in zip(NAMES, direction, strict=True) if abs(part) > 0.3)
        for direction in directions[:, size > 0.5].T
    )


def scale(face: Face, alignment: Alignment) -> tuple[float, float]:
    """(scale of the cloud over the design's, its uncertainty): a seventh parameter beside the six.

    The uncertainty is that of form errors alike over a sixteenth of the face: power looks like a scale.
    """
    grown = np.einsum("ij,ij->i", alignment.points - face.pivot, alignment.normals)
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    both = np.stack([grown, alignment.distances], axis=1)
    grown, distances = (both - columns @ np.linalg.solve(columns.T @ columns, columns.T @ both)).T
    energy = grown @ grown
    if energy <= (FLAT * face.reach) ** 2 * len(grown):  # a plane has no scale
        return 1.0, np.inf
    growth = grown @ distances / energy
    left = root_mean_square(distances - growth * grown)
    return 1 + float(growth), float(left / np.sqrt(energy / len(grown) * PATCHES))


# --- outliers ---------------------------------------------------------------------------------------------------------

NEIGHBOURS = 24  # of each point
TOGETHER = 8  # neighbours at the same distance, to half of it, that make an area
FAR = 6.0  # standard deviations, by the median of the absolute deviations (MAD), over the face or nearby
MAD = 1.4826  # from the MAD of normal numbers to their standard deviation
CAUCHY = 2.0  # standard deviations at which a neighbour's weight is halved
ROUNDS = 3  # of weighing the neighbours anew
AT_A_TIME = 20_000  # points
FINEST = 1e-6  # mm: below any measurement, above rounding


def isolated(
    points: np.ndarray, distances: np.ndarray, asked: np.ndarray, noise: float | None = None
) -> tuple[np.ndarray, float]:
    """(True for outliers (n,) among points (n, 3) in mm at distances (n,) from the face, the noise in mm).

    asked: (n,) points to be judged; the others are neighbours only.  noise: over the face, if it is known.
    """
    outliers, which = np.zeros(len(points), dtype=bool), np.flatnonzero(asked)
    if len(points) <= NEIGHBOURS or not len(which):
        return outliers, noise or 0.0
    tree = cKDTree(points[:, :2])
    parts = (_beside(tree, distances, which[k : k + AT_A_TIME]) for k in range(0, len(which), AT_A_TIME))
    off, spread, together = map(np.concatenate, zip(*parts, strict=True))
    if noise is None:
        noise = MAD * float(np.median(np.abs(off)))
    outliers[which] = (np.abs(off) > FAR * np.maximum(spread, noise) + FINEST) & (together < TOGETHER)
    return outliers, noise


def _beside(tree: cKDTree, distances: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of some points: distance from the plane of the neighbours, spread of these (mm), number of them beside the point.

    The plane is that of least squares by Cauchy's weights, which begin with the neighbours' median.
    """
    places = tree.data[part]
    _, near = tree.query(places, NEIGHBOURS + 1)
    near = near[:, 1:]  # without the point itself
    nearby = distances[near]
    across = tree.data[near] - places[:, None]
    size = np.abs(across).max(axis=(1, 2))[:, None, None] + FINEST
    columns = np.concatenate([np.ones_like(nearby)[..., None], across / size], axis=2)
    left = nearby - np.median(nearby, axis=1)[:, None]
    for _ in range(ROUNDS):
        spread = MAD * np.median(np.abs(left), axis=1)[:, None] + FINEST
        weighted = columns / (1 + (left / (CAUCHY * spread)) ** 2)[..., None]
        normal = np.einsum("nki,nkj->nij", weighted, columns) + 1e-6 * np.eye(3)  # neighbours may lie on a line
        plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", weighted, nearby)[..., None])
        left = nearby - (columns @ plane)[..., 0]
    off = distances[part] - plane[:, 0, 0]  # the plane where the point stands
    with_it = np.abs(left - off[:, None]) < np.abs(off)[:, None] / 2
    return off, MAD * np.median(np.abs(left), axis=1), with_it.sum(axis=1)


# --- where to start ---------------------------------------------------------------------------------------------------

NEAR = 1e-4  # of the half width: distance of a start that ends the search
SAMPLE, FEW = 3000, 1000  # points for the start; for exchanges of axes
START_STEPS, FEW_STEPS = 40, 15  # of Gauss-Newton from each start; for exchanges of axes
SHARE = 0.25  # of all points that a start must bring near the face
BETTER = 0.5  # of the distance of the cloud as given: a start replaces it below that
RING = 0.15  # of the half width: decentres to try where the nearest starts do not fit


def first_pose(face: Face, cloud: np.ndarray) -> tuple[Pose, float]:
    """(the best start, distance in mm of the nearest quarter of the points)."""
    sample = _sample(cloud)
    middle = _middle(sample)
    best = _best(face, sample, [np.zeros(2), middle], START_STEPS)
    if best[1] <= NEAR * face.reach:
        return best
    turns = 2 * np.pi * np.arange(8) / 8
    ring = RING * face.reach * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    further = _best(face, sample, [*ring, *(middle + ring)], START_STEPS)
    return further if further[1] < BETTER * best[1] else best


def exchanged_axes(face: Face, cloud: np.ndarray, kept: float) -> tuple[np.ndarray, str] | None:
    """(matrix (3, 3), words) of an exchange of axes by which the cloud fits far better than `kept` mm; None: none."""
    sample, fitting = _sample(cloud)[:: SAMPLE // FEW], []
    for matrix, words in sorted(_exchanges(), key=lambda exchange: _rarity(exchange[0])):
        turned = sample @ matrix.T
        pose, distance = _best(face, turned, [np.zeros(2), _middle(turned)], FEW_STEPS)
        if distance < BETTER * kept:
            fitting.append((distance, round(np.linalg.norm(pose.angles)), matrix, words))  # in whole degrees
    if not fitting:
        return None
    least = min(distance for distance, *_ in fitting) / BETTER
    # of exchanges that fit alike, the least turned: a swap of axes is also a mirror image that is turned
    _, _, matrix, words = min((fit for fit in fitting if fit[0] <= least), key=lambda fit: fit[1])
    return matrix, words


def _exchanges() -> Iterator[tuple[np.ndarray, str]]:
    """The 47 exchanges and reversals of axes with their words."""
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.diag(signs)[:, np.argsort(order)].astype(float)
        changed = [k for k in range(3) if order[k] != k or signs[k] < 0]
        if changed:
            yield matrix, ", ".join(f"{'xyz'[k]} is {'-' * (signs[k] < 0)}{'xyz'[order[k]]}" for k in changed)


def _rarity(matrix: np.ndarray) -> int:
    """The rarity of a mistake: axes that move, and twice those that are reversed."""
    return int((np.diag(matrix) == 0).sum() + 2 * (matrix < 0).sum())


def _sample(cloud: np.ndarray) -> np.ndarray:
    """SAMPLE points of a cloud, always the same."""
    return cloud[np.random.default_rng(0).permutation(len(cloud))[:SAMPLE]]


def _middle(points: np.ndarray) -> np.ndarray:
    """x and y (mm) of the middle of all points but a few stray ones."""
    return np.percentile(points, (1, 99), axis=0).sum(axis=0)[:2] / 2


def _best(face: Face, sample: np.ndarray, decentres: list[np.ndarray], steps: int) -> tuple[Pose, float]:
    """The best of several starts, the first unless another is clearly better."""
    best: tuple[Pose, float] | None = None
    for decentre in decentres:
        for height in _heights(face, sample, decentre):
            pose, kept = _followed(face, sample, unmoved(face, np.array([*decentre, height])), steps)
            if best is None or kept < BETTER * best[1]:
                best = pose, kept
    return best


def _heights(face: Face, sample: np.ndarray, decentre: np.ndarray) -> list[float]:
    """Shifts along z of the starts (mm): none, and that of the densest quarter of the points over the lens."""
    points = sample - np.array([*decentre, 0.0])
    over = points[face.inside(points)]
    if len(over) < 8:
        return [0.0]
    off = np.sort(face.height(over))
    quarter = len(off) // 4
    densest = int(np.argmin(off[quarter:] - off[:-quarter]))
    return [0.0, float(off[densest : densest + quarter].mean())]


def _followed(face: Face, sample: np.ndarray, pose: Pose, steps: int) -> tuple[Pose, float]:
    """Gauss-Newton with weights 1 / (1 + (d / s)²), s twice the distance of the nearest quarter of all points."""
    kept = np.inf
    for _ in range(steps):
        points = pose.undone(sample)
        points = points[face.inside(points)]
        if len(points) < max(8, SHARE * len(sample)):
            return pose, np.inf
        distances, normals = face.distance(points)
        kept = float(np.sort(np.abs(distances))[int(SHARE * len(sample)) - 1])
        weight = 1 / (1 + (distances / (2 * kept + 1e-9)) ** 2)
        motion, _ = step(face, points, distances, normals, weight=weight)
        pose = pose.after(motion * min(1.0, face.reach / 4 / max(np.abs(motion).max(), 1e-12)), face.reach)
        if np.abs(motion).max() < 1e-6 * face.reach:
            break
    return pose, kept
