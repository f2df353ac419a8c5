"""Points to spline: the rigid motion that brings a cloud onto the face, by Gauss-Newton, never by a mirror image.

Least squares of the signed distances d along the face's normals n, of all points but outliers.  A small motion, a shift
τ and a turn ω about the pivot c, changes the distance of a point q by n · τ + ((q - c) × n) · ω: six columns, written
in mm at the lens's rim so that shifts and turns compare.  Motions that hardly change any distance (the rotation of a
round face about its axis, the shift of a flat one) are not determined and stay zero.

It starts where a few thousand points, weighted so that those of sides and front do not pull, lead from several poses;
the best is kept, and the cloud as it was given unless another is clearly better.  Only proper motions are tried.  A
cloud that fits once its axes are exchanged or reversed is a fault, to be named.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import permutations, product

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bstcad.measured import outliers
from bstcad.measured.cloud import FEWEST
from bstcad.optics.lens import Lens

STEPS = 30  # of Gauss-Newton, at most
LOOKS = 6  # rounds of a search for outliers, at most
ENOUGH = 1e-10  # mm at the rim: the last step is smaller
FOOT_STEPS = 3  # towards the foot of a perpendicular; each leaves (distance x curvature) of the error before
INDEPENDENT = 100  # patches of a face with independent form errors
PATCHES = 16  # the same, of form errors that resemble a change of scale
LOOSE = 0.1  # of the lens's half width: a motion of that uncertainty by form errors is not determined
FLAT = 1e-7  # mm of distance for each mm of motion: less is rounding
RIM = 2e-3  # of the half width: nearer to the outline a point may lie on the edge
OFF_FACE = 0.25  # of the smallest thickness: farther points belong to the front, the sides or a fixture
SAMPLE = 3000  # points for the start
START_STEPS, FEW_STEPS = 40, 15  # of Gauss-Newton from each start; for exchanges of axes
SHARE = 0.25  # of all points that a start must bring near the face
BETTER = 0.5  # of the distance of the cloud as given: a start replaces it below that
RING = 0.15  # of the half width: decentres to try where the nearest starts do not fit
NAMES = ("shift in x", "shift in y", "shift in z", "rotation about x", "rotation about y", "rotation about z")


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
        x, y = _places(lens)
        back, front = (surface.sag_and_slope(x, y)[0] for surface in (lens.back, lens.front))
        vertex = float(lens.back.sag_and_slope(*torch.zeros(2, 1, dtype=torch.float64))[0])
        return cls(
            lens, np.array([0.0, 0.0, vertex]), max(lens.outline.half_extent), OFF_FACE * float((back - front).min())
        )

    def inside(self, points: np.ndarray) -> np.ndarray:
        """True for points over the outline, but for its very rim."""
        x, y = (torch.from_numpy(np.ascontiguousarray(points[:, i])) * (1 + RIM) for i in (0, 1))
        return self.lens.outline.contains(x, y).numpy()

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(signed distance (n,) in mm, + out of the glass; normal (n, 3) there), from the foot of the perpendicular."""
        target = torch.from_numpy(points)
        x, y = target[:, 0].contiguous(), target[:, 1].contiguous()
        for _ in range(FOOT_STEPS):
            z, z_x, z_y = self.lens.back.sag_and_slope(x, y)
            length = torch.sqrt(1 + z_x * z_x + z_y * z_y)
            n_x, n_y = -z_x / length, -z_y / length
            d = (target[:, 0] - x) * n_x + (target[:, 1] - y) * n_y + (target[:, 2] - z) / length
            x, y = target[:, 0] - d * n_x, target[:, 1] - d * n_y
        return d.numpy(), torch.stack([n_x, n_y, 1 / length], dim=1).numpy()

    def height(self, points: np.ndarray) -> np.ndarray:
        """(n,) heights along z (mm) of points above the face."""
        x, y = (torch.from_numpy(np.ascontiguousarray(points[:, i])) for i in (0, 1))
        return points[:, 2] - self.lens.back.sag_and_slope(x, y)[0].numpy()

    def columns(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(n, 6) change of each distance for a mm of shift in x, y, z, and of rotation about them at the rim."""
        return np.hstack([normals, np.cross(points - self.pivot, normals) / self.reach])


@dataclass(frozen=True)
class Pose:
    """Where the part lies in the frame of its cloud: from its place in the design, turned and then shifted.

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


def root_mean_square(values: np.ndarray) -> float:
    """sqrt(mean of squares)."""
    return float(np.sqrt(np.mean(values * values)))


def unmoved(face: Face) -> Pose:
    """The pose of a part whose cloud is in the frame of its design."""
    return Pose(np.eye(3), np.zeros(3), face.pivot)


def aligned(face: Face, cloud: np.ndarray, start: Pose) -> Alignment:
    """Least squares from a start near enough; all points of the face have one weight, outliers are left out.

    Outliers are searched at the start, and again among the points that lie on the face only after alignment.
    """
    pose, noise = start, None
    seen, out = np.zeros((2, len(cloud)), dtype=bool)
    for _ in range(LOOKS):
        points, inside, near = _chosen(face, cloud[~out], pose)
        which = np.flatnonzero(~out)[inside & near]
        if seen[which].all():
            break
        alone, noise = outliers.alone(points, face.distance(points)[0], ~seen[which], noise)
        if alone.any():  # the rest lies otherwise without them
            seen[:], noise = False, None
        else:
            seen[which] = True
        out[which] = alone
        pose = _squared(face, cloud[~out], pose)
    points, inside, near = _chosen(face, cloud[~out], pose)
    distances, normals = face.distance(points)
    _, motions = step(face, points, distances, normals)
    return Alignment(
        pose, points, distances, normals, motions=motions, undetermined=_left(motions), outside=int((~inside).sum()),
        off_face=int((inside & ~near).sum()), outliers=pose.undone(cloud[out]),
    )  # fmt: skip


def _squared(face: Face, cloud: np.ndarray, pose: Pose) -> Pose:
    """Least squares of all points of the face from a pose."""
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


def scale(face: Face, alignment: Alignment) -> tuple[float, float]:
    """(scale of the cloud over the design's, its uncertainty): a seventh parameter beside the six.

    The uncertainty is that of form errors alike over a sixteenth of the face: power looks like a scale.
    """
    grown = np.einsum("ij,ij->i", alignment.points - face.pivot, alignment.normals)
    columns = face.columns(alignment.points, alignment.normals) @ alignment.motions
    both = np.stack([grown, alignment.distances], axis=1)
    inner = columns.T @ columns
    grown, distances = (both - columns @ np.linalg.solve(inner, columns.T @ both)).T
    energy = grown @ grown
    if energy <= (FLAT * face.reach) ** 2 * len(grown):  # a plane has no scale
        return 1.0, np.inf
    found = grown @ distances / energy
    left = root_mean_square(distances - found * grown)
    return 1 + float(found), float(left / np.sqrt(energy / len(grown) * PATCHES))


def _chosen(face: Face, cloud: np.ndarray, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points of the face; True for points of the cloud inside the outline; True for points near the face)."""
    points = pose.undone(cloud)
    inside = face.inside(points)
    near = np.abs(face.height(points)) <= face.near
    chosen = inside & near
    if chosen.sum() < FEWEST:
        raise ValueError(
            f"{chosen.sum()} of its points come to lie on the back face, too few; give a cloud of that face"
        )
    return points[chosen], inside, near


def _left(motions: np.ndarray) -> tuple[str, ...]:
    """Motions that are not determined, in words; combined motions as one."""
    size, directions = np.linalg.eigh(np.eye(len(NAMES)) - motions @ motions.T)
    words = []
    for direction in directions[:, size > 0.5].T:
        parts = np.argsort(-np.abs(direction))
        words.append(" with ".join(NAMES[k] for k in sorted(k for k in parts if abs(direction[k]) > 0.3)))
    return tuple(words)


def _places(lens: Lens) -> tuple[torch.Tensor, torch.Tensor]:
    """x and y (mm) of a grid of 65 x 65 points, those inside the outline."""
    axes = (torch.linspace(-a, a, 65, dtype=torch.float64) for a in lens.outline.half_extent)
    x, y = (t.reshape(-1) for t in torch.meshgrid(*axes, indexing="ij"))
    inside = lens.outline.contains(x, y)
    return x[inside], y[inside]


# --- where to start ---------------------------------------------------------------------------------------------------


def first_pose(face: Face, cloud: np.ndarray, good: float) -> tuple[Pose, float]:
    """(the best start, distance in mm of the nearest quarter of the points); good: distance that ends the search."""
    sample = _sample(cloud)
    low, high = np.percentile(sample, (1, 99), axis=0)
    middle = (low + high)[:2] / 2
    best = _best(face, sample, [np.zeros(2), middle], START_STEPS)
    if best[1] <= good:
        return best
    turns = 2 * np.pi * np.arange(8) / 8
    ring = RING * face.reach * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    further = _best(face, sample, [*ring, *(middle + ring)], START_STEPS)
    return further if further[1] < BETTER * best[1] else best


def exchanged_axes(face: Face, cloud: np.ndarray, kept: float) -> tuple[np.ndarray, str] | None:
    """(matrix (3, 3), words) of an exchange of axes by which the cloud fits far better than `kept` mm; None: none."""
    sample, fitting = _sample(cloud)[:: SAMPLE // 1000], []
    for matrix, words in _exchanges():
        turned = sample @ matrix.T
        low, high = np.percentile(turned, (1, 99), axis=0)
        pose, found = _best(face, turned, [np.zeros(2), (low + high)[:2] / 2], FEW_STEPS)
        if found < BETTER * kept:
            fitting.append((found, round(np.linalg.norm(pose.angles)), matrix, words))  # in whole degrees
    if not fitting:
        return None
    least = min(found for found, *_ in fitting) / BETTER
    # of exchanges that fit alike, the least turned: a swap of axes is also a mirror image that is turned
    _, _, matrix, words = min((fit for fit in fitting if fit[0] <= least), key=lambda fit: fit[1])
    return matrix, words


def _exchanges() -> list[tuple[np.ndarray, str]]:
    """The 47 exchanges and reversals of axes with their words, the commonest mistakes first."""
    ways = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        changed = [k for k in range(3) if order[k] != k or signs[k] < 0]
        words = ", ".join(f"{'xyz'[k]} is {'-' * (signs[k] < 0)}{'xyz'[order[k]]}" for k in changed)
        if words:
            moved, reversals = sum(a != k for k, a in enumerate(order)), sum(s < 0 for s in signs)
            ways.append((moved + 2 * reversals, matrix, words))
    return [(matrix, words) for _, matrix, words in sorted(ways, key=lambda way: way[0])]


def _sample(cloud: np.ndarray) -> np.ndarray:
    """SAMPLE points of a cloud, always the same."""
    return cloud[np.random.default_rng(0).permutation(len(cloud))[:SAMPLE]]


def _best(face: Face, sample: np.ndarray, decentres: list[np.ndarray], steps: int) -> tuple[Pose, float]:
    """The best of several starts, the first unless another is clearly better."""
    best: tuple[Pose, float] | None = None
    for decentre in decentres:
        for height in _heights(face, sample, decentre):
            start = Pose(np.eye(3), np.array([*decentre, height]), face.pivot)
            pose, kept = _followed(face, sample, start, steps)
            if best is None or kept < BETTER * best[1]:
                best = pose, kept
    return best or (unmoved(face), np.inf)


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
