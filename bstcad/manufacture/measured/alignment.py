"""Align a cloud of measured points with a face: the rigid motion by Gauss-Newton least squares, without reflections.

The residuals are the signed distances d of all points except outliers, along the face's normals n.  A small motion,
with translation τ and rotation ω about the pivot c, changes the distance of a point q by n · τ + ((q - c) × n) · ω.
The factors of τ and ω are the six columns of the fit; rotations are in mm at the rim, to compare with translations.
Motions that hardly change any distance (a round face about its axis, a plane along itself) stay zero.

The search starts from several poses, with a few thousand points and robust weights, so that points of the sides and of
the front have little influence.  The pose as given is preferred unless another start is clearly better.  A cloud that
fits only after its axes are exchanged or reversed is reported as a fault.

Outliers are isolated points, caused by dust, glints and instrument errors; form errors cover an area.  Each point is
compared with the plane through its nearest neighbours.  It is an outlier if its distance from that plane exceeds noise
and form error, and if few neighbours lie at a similar distance: pits, bumps and edges of many points are form.
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
from bstcad.manufacture.measured.cloud import MIN_CLOUD_POINTS
from bstcad.optics.lens.lens import Lens
from bstcad.optics.surfaces.surfaces import sag

MAX_GAUSS_NEWTON_STEPS = 30  # maximum number of Gauss-Newton steps
MAX_OUTLIER_ROUNDS = 6  # maximum number of rounds of outlier rejection
STEP_TOLERANCE = 1e-10  # largest component (mm at the rim) of a step that ends the iteration
FOOT_ITERATIONS = 3  # iterations for the foot of a perpendicular; each multiplies the error by distance x curvature
INDEPENDENT_PATCHES = 100  # assumed number of patches of a face with independent form errors
LOW_ORDER_FORMS = 1  # assumed number of independent form errors of low order, which resemble a scale or a motion
MAX_MOTION_UNCERTAINTY = 0.1  # uncertainty of a motion (from form errors) / BackFace.reach, above which it stays zero
MIN_SENSITIVITY = 1e-7  # smallest RMS change of the distances per motion (mm/mm); smaller ones are rounding errors
RIM_MARGIN = 2e-3  # width of the ignored strip along the rim / half width of the face; points in it may lie on the edge
FACE_DISTANCE_FRACTION = 0.25  # largest distance along z of a point from the face / smallest thickness of the lens
MOTION_NAMES = ("shift in x", "shift in y", "shift in z", "rotation about x", "rotation about y", "rotation about z")


def root_mean_square(values: np.ndarray) -> float:
    """Return sqrt(mean(values²))."""
    return float(np.sqrt(np.mean(values * values)))


@dataclass(frozen=True)
class BackFace:
    """The back face of a lens, with which measured points are compared."""

    lens: Lens
    pivot: np.ndarray  # centre of rotations (3,), mm, on the axis of the face
    reach: float  # half of the larger side of the outline, mm
    max_distance: float  # distance along z (mm) above which a point does not belong to the face

    @classmethod
    def of(cls, lens: Lens) -> BackFace:
        """Return the back face of `lens`."""
        x, y = shape.inside(lens.outline, 65)
        front, back = (sag(surface, x.numpy(), y.numpy()) for surface in (lens.front, lens.back))
        max_distance = FACE_DISTANCE_FRACTION * float((back - front).min())
        pivot = np.array([0.0, 0.0, float(sag(lens.back, 0.0, 0.0))])
        return cls(lens, pivot, max(lens.outline.half_extent), max_distance)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the points (n, 3) inside the outline, except those within RIM_MARGIN of the rim."""
        return self.lens.outline.contains(*torch.from_numpy(points[:, :2].T * (1 + RIM_MARGIN))).numpy()

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return signed distances (n,), mm, positive outside the glass, and normals (n, 3) at the nearest points."""
        surface, (x, y, z) = self.lens.back.plain(), np.ascontiguousarray(points.T)
        foot_x, foot_y = x, y
        for _ in range(FOOT_ITERATIONS):
            at = surface.sag_and_slope(torch.from_numpy(foot_x), torch.from_numpy(foot_y))
            sag_here, z_x, z_y = (value.numpy() for value in at)
            length = np.sqrt(1 + z_x * z_x + z_y * z_y)
            n_x, n_y = -z_x / length, -z_y / length
            d = (x - foot_x) * n_x + (y - foot_y) * n_y + (z - sag_here) / length
            foot_x, foot_y = x - d * n_x, y - d * n_y
        return d, np.stack([n_x, n_y, 1 / length], axis=1)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the heights (n,) of points above the face along z (mm)."""
        return points[:, 2] - sag(self.lens.back, *points[:, :2].T)

    def columns(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return changes (n, 6) of the distances per mm of shift along, or rotation (at the rim) about, x, y and z."""
        (x, y, z), (n_x, n_y, n_z) = np.ascontiguousarray((points - self.pivot).T), normals.T
        turns = (y * n_z - z * n_y, z * n_x - x * n_z, x * n_y - y * n_x)
        return np.stack([n_x, n_y, n_z, *(turn / self.reach for turn in turns)], axis=1)


@dataclass(frozen=True)
class Pose:
    """Pose of a part in the frame of its cloud: a design point p lies at R (p - pivot) + pivot + shift."""

    rotation: np.ndarray  # proper rotation R (3, 3)
    shift: np.ndarray  # translation (3,), mm
    pivot: np.ndarray  # centre of the rotation (3,), mm

    def to_design(self, points: np.ndarray) -> np.ndarray:
        """Return points (n, 3) of the cloud in the frame of the design."""
        return (points - self.pivot - self.shift) @ self.rotation + self.pivot

    def compose(self, motion: np.ndarray, reach: float) -> Pose:
        """Return the pose whose `to_design` is this pose's, followed by `motion` (6,), mm as in BackFace.columns."""
        turn = Rotation.from_rotvec(motion[3:] / reach).as_matrix()
        rotation = self.rotation @ turn.T
        return Pose(rotation, self.shift - rotation @ motion[:3], self.pivot)

    @property
    def angles(self) -> np.ndarray:
        """Rotation vector (3,) about x, y and z, degrees."""
        return np.degrees(Rotation.from_matrix(self.rotation).as_rotvec())


def identity_pose(face: BackFace, shift: np.ndarray | None = None) -> Pose:
    """Return the pose without rotation, with a shift (mm) if one is given."""
    return Pose(np.eye(3), np.zeros(3) if shift is None else shift, face.pivot)


@dataclass(frozen=True)
class Alignment:
    """A cloud aligned with the face."""

    pose: Pose  # pose of the part in the frame of the cloud
    points: np.ndarray = field(repr=False)  # points of the face (n, 3), mm, in the frame of the design
    distances: np.ndarray = field(repr=False)  # signed distances along the normal (n,), mm
    normals: np.ndarray = field(repr=False)  # unit normals of the face at the points (n, 3)
    motions: np.ndarray = field(repr=False)  # orthonormal motions (6, k) that the points of the face determine
    undetermined: tuple[str, ...]  # names of the motions that the face does not determine
    outside: int  # number of points outside the outline, or on its rim
    off_face: int  # number of points inside the outline, but far from the face
    outliers: np.ndarray = field(repr=False)  # isolated points near the face (k, 3), mm, in the frame of the design
    out: np.ndarray = field(repr=False)  # mask of the outliers among the points of the cloud

    @property
    def outlier_fraction(self) -> float:
        """Fraction of outliers among the points near the face."""
        return len(self.outliers) / (len(self.outliers) + len(self.points))

    @property
    def turns_freely(self) -> bool:
        """True if the points do not determine the rotation about the axis."""
        return MOTION_NAMES[-1] in self.undetermined

    @property
    def rms(self) -> float:
        """RMS of the distances (mm)."""
        return root_mean_square(self.distances)


def align(face: BackFace, cloud: np.ndarray, start: Pose) -> Alignment:
    """Align a cloud (n, 3) in mm with a face by least squares, with equal weights and without outliers.

    start: a pose near the solution, at which outliers are sought.  After each alignment, they are sought again: among
    all points if there were any, else among points that have come onto the face.
    """
    pose, noise = start, None
    judged, out = np.zeros((2, len(cloud)), dtype=bool)
    for _ in range(MAX_OUTLIER_ROUNDS):
        points, inside, near = _face_points(face, cloud[~out], pose)
        chosen = np.flatnonzero(~out)[inside & near]
        if judged[chosen].all():
            break
        isolated, noise = find_outliers(points, face.distance(points)[0], ~judged[chosen], noise)
        if isolated.any():  # the alignment changes without them, so that all points are judged again
            judged[:], noise = False, None
        else:
            judged[chosen] = True
        out[chosen] = isolated
        pose = _least_squares(face, cloud[~out], pose)
    return at_pose(face, cloud, pose, out)


def at_pose(face: BackFace, cloud: np.ndarray, pose: Pose, out: np.ndarray) -> Alignment:
    """Return the alignment of a cloud (n, 3) at a pose; out: mask (n,) of the outliers."""
    points, inside, near = _face_points(face, cloud[~out], pose)
    distances, normals = face.distance(points)
    _, motions = gauss_newton_step(face, points, distances, normals)
    counts = {"outside": int((~inside).sum()), "off_face": int((inside & ~near).sum())}
    free, outliers = _undetermined(motions), pose.to_design(cloud[out])
    return Alignment(
        pose, points, distances, normals, motions=motions, undetermined=free, outliers=outliers, out=out, **counts
    )


def _least_squares(face: BackFace, cloud: np.ndarray, pose: Pose) -> Pose:
    """Return the pose by least squares of all points that lie on the face, starting from a pose near the solution."""
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
        points, *_ = _face_points(face, cloud, pose)
        motion, _ = gauss_newton_step(face, points, *face.distance(points))
        pose = pose.compose(motion, face.reach)
        if np.abs(motion).max() < STEP_TOLERANCE:
            break
    return pose


def gauss_newton_step(
    face: BackFace, points: np.ndarray, distances: np.ndarray, normals: np.ndarray, weight: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return a Gauss-Newton step (6,) and an orthonormal basis (6, k) of the motions that the points determine.

    The six components are those of BackFace.columns.  weight (n,): weights of the points; None: equal weights.
    """
    columns = face.columns(points, normals)
    weight = np.full(len(points), 1 / len(points)) if weight is None else weight / weight.sum()
    weighted = columns * weight[:, None]
    sensitivity2, directions = np.linalg.eigh(columns.T @ weighted)
    spread = np.sqrt(weight @ distances**2)
    by_form = spread / (np.sqrt(INDEPENDENT_PATCHES) * MAX_MOTION_UNCERTAINTY * face.reach)
    determined = sensitivity2 > max(MIN_SENSITIVITY, by_form) ** 2
    motions = directions[:, determined]
    return -motions @ ((motions.T @ (weighted.T @ distances)) / sensitivity2[determined]), motions


def _face_points(face: BackFace, cloud: np.ndarray, pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (points (n, 3) of the face; masks of the cloud's points: inside the outline; near the face)."""
    points = pose.to_design(cloud)
    inside, near = face.contains(points), np.abs(face.height(points)) <= face.max_distance
    chosen = points[inside & near]
    if len(chosen) < MIN_CLOUD_POINTS:
        raise ValueError(
            f"only {len(chosen)} of its points lie on the back face after alignment; give a cloud of that face"
        )
    return chosen, inside, near


def _undetermined(motions: np.ndarray) -> tuple[str, ...]:
    """Return the names of the motions that `motions` (6, k) do not span; a combined motion is one entry."""
    size, directions = np.linalg.eigh(np.eye(len(MOTION_NAMES)) - motions @ motions.T)
    return tuple(
        " with ".join(name for name, part in zip(MOTION_NAMES, direction, strict=True) if abs(part) > 0.3)
        for direction in directions[:, size > 0.5].T
    )


# --- outliers ---------------------------------------------------------------------------------------------------------

NEIGHBOURS = 24  # number of nearest points with which each point is compared
MIN_CLUSTER = 8  # smallest number of neighbours with 50 to 150 % of a point's deviation that shows form, not an outlier
OUTLIER_THRESHOLD = 6.0  # minimum deviation of an outlier, in standard deviations of neighbours or (if larger) of all
MAD_TO_SIGMA = 1.4826  # ratio of standard deviation to median absolute deviation (MAD) of a normal distribution
CAUCHY_SCALE = 2.0  # residual, in standard deviations, at which a neighbour's weight is one half
REWEIGHTING_ROUNDS = 3  # iterations of the neighbours' weights
POINT_CHUNK = 20_000  # number of points that are judged at a time, which bounds the memory
MIN_POINT_NOISE = 1e-6  # lower bound of the noise, mm: below any measurement, above rounding


def find_outliers(
    points: np.ndarray, distances: np.ndarray, candidates: np.ndarray, noise: float | None = None
) -> tuple[np.ndarray, float]:
    """Return a mask (n,) of the outliers among points (n, 3) at distances (n,) from the face, and the noise (mm).

    candidates: mask (n,) of the points to judge; the others are only neighbours.  noise (mm); None: estimated.
    """
    outliers, which = np.zeros(len(points), dtype=bool), np.flatnonzero(candidates)
    if len(points) <= NEIGHBOURS or not len(which):
        return outliers, noise or 0.0
    tree = cKDTree(points[:, :2])
    parts = (_neighbour_planes(tree, distances, which[k : k + POINT_CHUNK]) for k in range(0, len(which), POINT_CHUNK))
    off, spread, similar = map(np.concatenate, zip(*parts, strict=True))
    if noise is None:
        noise = MAD_TO_SIGMA * float(np.median(np.abs(off)))
    outlying = np.abs(off) > OUTLIER_THRESHOLD * np.maximum(spread, noise) + MIN_POINT_NOISE
    outliers[which] = outlying & (similar < MIN_CLUSTER)
    return outliers, noise


def _neighbour_planes(
    tree: cKDTree, distances: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare the points with indices `part` with the planes through their neighbours, fitted with Cauchy weights.

    Return the distance of each point from its plane, its neighbours' spread (mm), and how many have a similar distance.
    """
    positions = tree.data[part]
    _, near = tree.query(positions, NEIGHBOURS + 1)
    near = near[:, 1:]  # without the point itself
    nearby = distances[near]
    across = tree.data[near] - positions[:, None]
    size = np.abs(across).max(axis=(1, 2))[:, None, None] + MIN_POINT_NOISE
    columns = np.concatenate([np.ones_like(nearby)[..., None], across / size], axis=2)
    left = nearby - np.median(nearby, axis=1)[:, None]
    for _ in range(REWEIGHTING_ROUNDS):
        spread = MAD_TO_SIGMA * np.median(np.abs(left), axis=1)[:, None] + MIN_POINT_NOISE
        weighted = columns / (1 + (left / (CAUCHY_SCALE * spread)) ** 2)[..., None]
        normal = np.einsum("nki,nkj->nij", weighted, columns) + 1e-6 * np.eye(3)  # neighbours may lie on a line
        plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", weighted, nearby)[..., None])
        left = nearby - (columns @ plane)[..., 0]
    off = distances[part] - plane[:, 0, 0]  # height of the plane at the point itself
    similar = np.abs(left - off[:, None]) < np.abs(off)[:, None] / 2
    return off, MAD_TO_SIGMA * np.median(np.abs(left), axis=1), similar.sum(axis=1)


# --- poses that fit equally well --------------------------------------------------------------------------------------

MAX_FOLD = 12  # largest number of equal turns about the axis that are sought
EQUAL_SIGMAS = 3.0  # excess of a turned pose's mean square distance, in its standard deviations, that tells the poses
MAX_TURNED_OUT = 0.02  # fraction of points outside the outline after a turn, above which the outline tells the pose
TURN_SAMPLE = 5000  # maximum number of points by which turned poses are compared


def turn_about_axis(face: BackFace, angle: float) -> np.ndarray:
    """Return the motion (6,) that turns by an angle (degrees) about the axis; see Pose.compose."""
    return np.array([0.0, 0.0, 0.0, 0.0, 0.0, face.reach * np.radians(angle)])


def equal_turns(face: BackFace, alignment: Alignment) -> tuple[float, ...]:
    """Return the angles (degrees, 0 excluded) about the axis at which the part fits as well: multiples of 360 / n.

    A turned pose has the distances d', after the best small motion.  It fits as well if mean(d'²) - mean(d²) does not
    exceed EQUAL_SIGMAS standard deviations 2 rms(d) rms(d' - d) / sqrt(N), N: number of independent form errors.
    """
    chosen = np.random.default_rng(0).permutation(len(alignment.points))[:TURN_SAMPLE]
    points, distances, found = alignment.points[chosen], alignment.distances[chosen], []
    rms, number = max(root_mean_square(distances), MIN_POINT_NOISE), min(len(points), INDEPENDENT_PATCHES)
    for angle in sorted({360 * k / n for n in range(2, MAX_FOLD + 1) for k in range(1, n)}):
        turned = identity_pose(face).compose(turn_about_axis(face, angle), face.reach).to_design(points)
        inside = face.contains(turned)
        if 1 - inside.mean() > MAX_TURNED_OUT:
            continue
        off, normals = face.distance(turned[inside])
        columns = face.columns(turned[inside], normals) @ alignment.motions
        off = off - columns @ np.linalg.lstsq(columns, off, rcond=None)[0]
        change = root_mean_square(off - distances[inside])
        excess = np.mean(off**2) - np.mean(distances[inside] ** 2)
        if excess <= EQUAL_SIGMAS * 2 * rms * change / np.sqrt(number):
            found.append(angle)
    return tuple(found)


# --- starting poses ---------------------------------------------------------------------------------------------------

START_TOLERANCE = 1e-4  # distance of `first_pose` / BackFace.reach, up to which the best start is accepted at once
START_SAMPLE, AXES_SAMPLE = 3000, 1000  # number of points for the starts, and for exchanges of axes
START_STEPS, AXES_STEPS = 40, 15  # Gauss-Newton steps from each start, and for turns and exchanges of axes
TURNS = 72  # number of turns about the axis that are tried; 5° apart, fine relief still leads to the right one
START_FRACTION = 0.25  # fraction of the points, the nearest ones inside the outline, by which a start is judged
IMPROVEMENT_RATIO = 0.5  # ratio of a later start's distance to the best so far, below which the later one replaces it
DECENTRE_RING = 0.15  # ratio of the decentre of further starts to BackFace.reach, used if the first ones do not fit


def first_pose(face: BackFace, cloud: np.ndarray) -> tuple[Pose, float]:
    """Return the best starting pose, and the distance (mm) within which the nearest quarter of the points lies."""
    sample = _sample(cloud)
    middle = _middle(sample)
    best = _best_start(face, sample, [np.zeros(2), middle], START_STEPS)
    if best[1] <= START_TOLERANCE * face.reach:
        return best
    turns = 2 * np.pi * np.arange(8) / 8
    ring = DECENTRE_RING * face.reach * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    further = _best_start(face, sample, [*ring, *(middle + ring)], START_STEPS)
    return further if further[1] < IMPROVEMENT_RATIO * best[1] else best


def find_turned_pose(face: BackFace, cloud: np.ndarray, pose: Pose, original: float) -> Pose | None:
    """Return a pose turned about the axis that more than halves `first_pose`'s distance `original`, or None.

    Both `pose` and the cloud as given are turned, since a cloud at a wrong angle can lead `pose` far astray.
    """
    sample = _sample(cloud)[:: START_SAMPLE // AXES_SAMPLE]
    turns = np.outer(2 * np.pi * np.arange(1, TURNS) / TURNS, [0.0, 0.0, 0.0, 0.0, 0.0, face.reach])
    starts = (start.compose(turn, face.reach) for start in (identity_pose(face, np.zeros(3)), pose) for turn in turns)
    turned, distance = min((_refine_start(face, sample, start, AXES_STEPS) for start in starts), key=lambda fit: fit[1])
    return turned if distance < IMPROVEMENT_RATIO * original else None


def find_axis_exchange(face: BackFace, cloud: np.ndarray, original: float) -> tuple[np.ndarray, str] | None:
    """Return (matrix, words) of an axis exchange that more than halves `first_pose`'s distance `original`, or None."""
    sample, fitting = _sample(cloud)[:: START_SAMPLE // AXES_SAMPLE], []
    for matrix, words in sorted(_axis_exchanges(), key=lambda exchange: _rarity(exchange[0])):
        turned = sample @ matrix.T
        pose, distance = _best_start(face, turned, [np.zeros(2), _middle(turned)], AXES_STEPS)
        if distance < IMPROVEMENT_RATIO * original:
            fitting.append((distance, round(np.linalg.norm(pose.angles)), matrix, words))  # in whole degrees
    if not fitting:
        return None
    least = min(distance for distance, *_ in fitting) / IMPROVEMENT_RATIO
    # choose the smallest rotation among equal fits: a swap of axes equals a reflection and a rotation
    _, _, matrix, words = min((fit for fit in fitting if fit[0] <= least), key=lambda fit: fit[1])
    return matrix, words


def _axis_exchanges() -> Iterator[tuple[np.ndarray, str]]:
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.diag(signs)[:, np.argsort(order)].astype(float)
        changed = [k for k in range(3) if order[k] != k or signs[k] < 0]
        if matrix[2, 2] < 1 or np.linalg.det(matrix) < 0:  # not a turn about the axis; see find_turned_pose
            yield matrix, ", ".join(f"{'xyz'[k]} is {'-' * (signs[k] < 0)}{'xyz'[order[k]]}" for k in changed)


def _rarity(matrix: np.ndarray) -> int:
    """Rank an exchange by its rarity: number of moved axes plus twice the number of reversed axes."""
    return int((np.diag(matrix) == 0).sum() + 2 * (matrix < 0).sum())


def _sample(cloud: np.ndarray) -> np.ndarray:
    """Return at most START_SAMPLE random points of a cloud, chosen with a fixed seed."""
    return cloud[np.random.default_rng(0).permutation(len(cloud))[:START_SAMPLE]]


def _middle(points: np.ndarray) -> np.ndarray:
    """Return x and y (mm) of the centre of the points' extent, without the outermost percent at each end."""
    return np.percentile(points, (1, 99), axis=0).sum(axis=0)[:2] / 2


def _best_start(face: BackFace, sample: np.ndarray, decentres: list[np.ndarray], steps: int) -> tuple[Pose, float]:
    """Return pose and distance (mm) of the best start from `decentres` (mm); a later one must be clearly better."""
    shifts = (np.array([*decentre, height]) for decentre in decentres for height in _heights(face, sample, decentre))
    first, *later = (_refine_start(face, sample, identity_pose(face, shift), steps) for shift in shifts)
    best = first
    for pose, distance in later:
        if distance < IMPROVEMENT_RATIO * best[1]:
            best = pose, distance
    return best


def _heights(face: BackFace, sample: np.ndarray, decentre: np.ndarray) -> list[float]:
    """Return the z shifts (mm) of the starts: zero, and the height of the densest quarter of the points."""
    points = sample - np.array([*decentre, 0.0])
    over = points[face.contains(points)]
    if len(over) < 8:
        return [0.0]
    off = np.sort(face.height(over))
    quarter = len(off) // 4
    densest = int(np.argmin(off[quarter:] - off[:-quarter]))
    return [0.0, float(off[densest : densest + quarter].mean())]


def _refine_start(face: BackFace, sample: np.ndarray, pose: Pose, steps: int) -> tuple[Pose, float]:
    """Return (pose after at most `steps` Gauss-Newton steps, q): a quarter of the sample has |d| <= q (mm).

    Weights are 1 / (1 + (d / (2 q))²).  q is infinite if too few points lie inside the outline.
    """
    distance = np.inf
    for _ in range(steps):
        points = pose.to_design(sample)
        points = points[face.contains(points)]
        if len(points) < max(8, START_FRACTION * len(sample)):
            return pose, np.inf
        distances, normals = face.distance(points)
        distance = float(np.sort(np.abs(distances))[int(START_FRACTION * len(sample)) - 1])
        weight = 1 / (1 + (distances / (2 * distance + 1e-9)) ** 2)
        motion, _ = gauss_newton_step(face, points, distances, normals, weight=weight)
        pose = pose.compose(motion * min(1.0, face.reach / 4 / max(np.abs(motion).max(), 1e-12)), face.reach)
        if np.abs(motion).max() < 1e-6 * face.reach:
            break
    return pose, distance
