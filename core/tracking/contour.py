"""Contours: snakes (Kass, Witkin & Terzopoulos 1988, doi:10.1007/BF00133570), predicted from frame to frame by nearby trajectories
(D'Apuzzo et al. 2000, §5).

    u(s) = Σ w_j (x_j,i+1 − x_j,i) / Σ w_j ,   w = exp(−d² / 2 ρ²) over projected trajectories inside the contour       (1)
    (α D2 + β D4 + γ I) v ← γ v − ∂E/∂x ,   E = −|∇(G_σ * I)|²                                                        (2)

v is the displacement from the predicted contour, not the contour itself, so the snake preserves its shape: it neither shrinks nor loses
its corners. D2, D4 are the circulant second and fourth differences, γ = 1. On printed cloth the largest gradient is seldom at the outline.
In addition to −∂E/∂x, every vertex is therefore attracted by the point that best divides the grey values along its normal into two parts of
different mean and contrast (the likelihood of two Gaussians; c runs along the normal):

    c → min  n₁ log σ₁²(s < c) + n₂ log σ₂²(s > c)                                                        (3)

A vertex stays in place unless some c is significantly likelier, so the predicted contour is unchanged where there is no edge.

Finally every vertex moves to the largest gradient within a pixel or two of (3), at the vertex of the parabola through the three largest
values, and outwards by the amount that blur displaces an edge of the curvature κ, with the width w = √(g₀ / |g₋ − 2 g₀ + g₊|):

    s = (g₋ − g₊) / 2 (g₋ − 2 g₀ + g₊) + κ w² / 2 ,   σ_s = σ_g / (√2 |g₋ − 2 g₀ + g₊|)                                  (4)

Texture on both sides displaces the largest gradient as well. With σ_t, the texture's gradient beyond the edge, both sides combined:

    σ² = σ_s² + σ_t² w² / (2 π g₀²) ,   not less than the scatter of the neighbouring vertices about a smooth curve                (5)

Full-frame pixels; contours are closed, with vertices at equal distances.

Their file, contours/VIEW.csv, is read frame by frame on access, so that memory does not limit its length. It is scanned once for the
positions at which each frame's rows begin and end; the rows of a frame are consecutive.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..foundation import bounded
from ..foundation.errors import InputError
from ..foundation.settings import knob
from ..geometry.robust import mad_sigma
from ..images.sampling import LONGEST_LOOK_UP

REACH_PX = 40.0  # of (1): largest distance between a vertex and a point
RHO_PX = 15.0  # of (1)
INSIDE_PX = 2.0  # a point counts as inside the contour up to this distance beyond it
MAX_FORCE_PX = 1.0  # per iteration
CONVERGED_PX = 0.02  # largest step of a vertex at which the snake stops
NEIGHBOURS = 8  # vertices on each side over which scatter is estimated
EDGE_SEARCH_PX = 2  # largest distance of the gradient's maximum from (3)
MIN_SIGMA_PX = 0.025  # of a vertex, from interpolating the parabola
NO_EDGE_SIGMA_PX = 3.0  # of a vertex without an edge
FINAL_SEARCH_PX = 2.0  # range of the last evaluation of (3)
MAX_FINAL_STEP_PX = 1.0  # of a vertex after it
MAX_WIDTH_BLURS = 2.0  # of w, in units of the blur
FLOW_GRID_PX = 6.0  # distance between points tracked by optical flow
FLOW_WINDOW_PX = 15  # window of the optical flow
FLOW_RETURN_PX = 1.0  # largest distance between a point and its match back
IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6  # Immerkær 1996
MIN_NOISE = 0.3  # grey values, of quantization
PROFILE_PX = 6  # of (3): length of a profile beyond the search range
MIN_VARIANCE = 4.0  # of (3), grey values squared, of noise
SIGNIFICANT = 20.0  # of (3), twice a difference of log likelihoods; noise alone reaches it at one vertex in a thousand
SIDES = (-5.0, -4.0, 4.0, 5.0)  # distances from the edge at which texture is measured, in units of the blur
SMOOTH = np.array([-2, 3, 6, 7, 6, 3, -2]) / 21  # the quadratic through seven vertices (Savitzky & Golay 1964); residuals have 2/3 σ²
OWN_SHARE = 0.2  # weight of a vertex's own residual in its scatter; the rest is that of its neighbours
REGION_INTERVAL = 10  # iterations between evaluations of (3)
REGION_WEIGHT = 0.7  # of the attraction by (3)
EDGE_SIGMAS = 5.0  # smallest gradient of an edge, in units of the gradient's noise


@dataclass(frozen=True, kw_only=True, slots=True)
class ContourSettings:
    """How a contour is fitted to the edges of the image."""

    spacing_px: float = knob(4.0, "Distance between the vertices.", unit="px", low=1.0, high=50.0)
    blur_px: float = knob(1.5, "Blur of the image whose gradient attracts the contour.", unit="px", low=0.5, high=10.0)
    search_px: float = knob(6.0, "Distance along its normal in which a vertex searches for the outline.", unit="px", low=1.0, high=30.0)
    alpha: float = knob(0.05, "Resistance to stretching.", low=0.0, high=100.0)
    beta: float = knob(2.0, "Resistance to bending.", low=0.0, high=100.0)
    iterations: int = knob(60, "Largest number of iterations of the snake.", low=1, high=5000)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Contour:
    """A closed contour in one image: observations of the silhouette, each of the position across the contour only."""

    xy_px: np.ndarray  # (V, 2)
    normal: np.ndarray  # (V, 2) unit, outwards
    sigma_px: np.ndarray  # (V,) along the normal; NO_EDGE_SIGMA_PX where no edge was found
    on_edge: np.ndarray  # (V,) whether the vertex lies on an edge


def contour_of_mask(mask: np.ndarray, spacing_px: float) -> np.ndarray:
    """Vertices (V, 2) of the outline of a mask's largest region (h, w); none if the mask is empty."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return np.zeros((0, 2))
    largest = max(outlines, key=cv2.contourArea)[:, 0].astype(np.float64)
    return resampled(largest, spacing_px) if len(largest) > 3 else np.zeros((0, 2))


def mask_of_points(xy_px: np.ndarray, size_px: tuple[int, int], radius_px: float) -> np.ndarray:
    """The region (h, w) covered by points (N, 2): each dilated to a disc, which closes small gaps, then eroded by the radius."""
    mask = np.zeros(size_px[::-1], dtype=np.uint8)
    inside = xy_px[np.isfinite(xy_px).all(axis=1)]
    at = np.rint(inside).astype(np.int64)
    at = at[(at >= 0).all(axis=1) & (at < np.array(size_px)).all(axis=1)]
    mask[at[:, 1], at[:, 0]] = 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius_px) + 1,) * 2)
    return cv2.erode(cv2.dilate(mask, disc), disc).astype(bool)


def resampled(xy_px: np.ndarray, spacing_px: float, count: int | None = None) -> np.ndarray:
    """The closed polygon (V, 2) with vertices at equal distances of about `spacing_px`, or with `count` vertices."""
    closed = np.concatenate([xy_px, xy_px[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = count or max(8, round(length[-1] / spacing_px))
    at = np.arange(count) / count * length[-1]
    return np.stack([np.interp(at, length, closed[:, i]) for i in range(2)], axis=1)


def predict_contour(xy_px: np.ndarray, before_px: np.ndarray, after_px: np.ndarray) -> np.ndarray:
    """The contour (V, 2) displaced like the tracked points (N, 2) inside it, from `before_px` to `after_px`.  (1)

    A vertex without points within REACH_PX is displaced like its neighbours on the contour.
    """
    polygon = xy_px.astype(np.float32).reshape(-1, 1, 2)
    known = np.isfinite(before_px).all(axis=1) & np.isfinite(after_px).all(axis=1)
    p, q = before_px[known], after_px[known]
    inner = np.array([cv2.pointPolygonTest(polygon, (float(x), float(y)), True) > -INSIDE_PX for x, y in p], dtype=bool)
    p, q = p[inner], q[inner]
    if not len(p):
        return xy_px.copy()
    d2 = ((xy_px[:, None] - p) ** 2).sum(axis=2)
    w = np.where(d2 <= REACH_PX**2, np.exp(-d2 / (2 * RHO_PX**2)), 0.0)
    total = w.sum(axis=1)
    near = total > 1e-6
    if not near.any():
        return xy_px + np.median(q - p, axis=0)
    u = (w[near] @ (q - p)) / total[near, None]
    places, n = np.flatnonzero(near), len(xy_px)
    wrapped = np.concatenate([places - n, places, places + n])
    return xy_px + np.stack([np.interp(np.arange(n), wrapped, np.tile(u[:, i], 3)) for i in range(2)], axis=1)


def carried_points(xy_px: np.ndarray, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) of a grid inside a contour (V, 2) in one image, and their positions (N, 2) in the next (Lucas & Kanade 1981, with
    pyramids: Bouguet 2000), without those that the flow back does not return to their start."""
    low, high = np.floor(xy_px.min(axis=0)), np.ceil(xy_px.max(axis=0))
    grid = np.stack(np.meshgrid(*(np.arange(a, b + 1, FLOW_GRID_PX) for a, b in zip(low, high))), axis=-1).reshape(-1, 2).astype(np.float32)
    polygon = xy_px.astype(np.float32).reshape(-1, 1, 2)
    start = grid[[cv2.pointPolygonTest(polygon, (float(x), float(y)), False) >= 0 for x, y in grid]]
    if not len(start):
        return np.zeros((0, 2)), np.zeros((0, 2))
    images = [np.clip(image, 0, 255).astype(np.uint8) for image in (before, after)]
    there, found, _ = cv2.calcOpticalFlowPyrLK(*images, start, np.zeros_like(start), winSize=(FLOW_WINDOW_PX, FLOW_WINDOW_PX))
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(*images[::-1], there, np.zeros_like(start), winSize=(FLOW_WINDOW_PX, FLOW_WINDOW_PX))
    good = (found[:, 0] > 0) & (found_back[:, 0] > 0) & (np.linalg.norm(back - start, axis=1) < FLOW_RETURN_PX)
    return start[good].astype(np.float64), there[good].astype(np.float64)


def relax_contour(predicted_px: np.ndarray, grey: np.ndarray, settings: ContourSettings) -> Contour:
    """Fit a predicted contour (V, 2) to the edges of an image (h, w).  (2) to (5)"""
    start = resampled(predicted_px, settings.spacing_px)
    gradient = _gradient(grey, settings.blur_px)
    strength = np.hypot(*gradient)
    edge = max(float(np.percentile(strength, 99)), EDGE_SIGMAS * gradient_noise(grey, settings.blur_px))
    energy = -((strength / edge) ** 2)
    force = [-cv2.Sobel(energy, cv2.CV_32F, i, 1 - i, ksize=3, scale=1 / 8) * 4 for i in (1, 0)]
    inverse = np.linalg.inv(_stiffness(len(start), settings))
    v = np.zeros_like(start)
    for iteration in range(settings.iterations):
        if iteration % REGION_INTERVAL == 0:
            normal = outward_normals(start + v)
            goal = v + _division(grey, start + v, normal, settings.search_px)[:, None] * normal
        f = np.stack([_sample(part, start + v) for part in force], axis=1) + REGION_WEIGHT * (goal - v)
        f /= np.maximum(1.0, np.linalg.norm(f, axis=1, keepdims=True) / MAX_FORCE_PX)
        step = inverse @ (v + f) - v
        v += step
        if np.abs(step).max() < CONVERGED_PX and iteration % REGION_INTERVAL:
            break
    return _on_edges(start + v, gradient, grey, settings)


def _division(grey: np.ndarray, xy: np.ndarray, normal: np.ndarray, search_px: float) -> np.ndarray:
    """Position (V,) along each vertex's normal that best divides the grey values, from profiles through it and its neighbours.  (3)

    Zero where no position is significantly better than the vertex itself.
    """
    reach = round(search_px) + PROFILE_PX
    s = np.arange(-reach, reach + 1).astype(np.float64)
    values = _sample(grey.astype(np.float32), xy[:, None] + s[:, None] * normal[:, None])
    profiles = np.stack([np.roll(values, d, axis=0) for d in (-1, 0, 1)])
    weight = np.ones_like(profiles)

    def log_variance(part: slice) -> np.ndarray:
        n = weight[:, :, part].sum(axis=(0, 2))
        mean = profiles[:, :, part].sum(axis=(0, 2)) / n
        square = (profiles[:, :, part] ** 2).sum(axis=(0, 2)) / n
        return n * np.log(np.maximum(square - mean**2, MIN_VARIANCE))

    middle = range(PROFILE_PX, len(s) - PROFILE_PX)
    cost = np.stack([log_variance(slice(None, c)) + log_variance(slice(c + 1, None)) for c in middle], axis=1)
    gain = cost[:, cost.shape[1] // 2] - cost.min(axis=1)
    return np.where(gain > SIGNIFICANT, s[PROFILE_PX : len(s) - PROFILE_PX][cost.argmin(axis=1)], 0.0)


def _stiffness(n: int, settings: ContourSettings) -> np.ndarray:
    """α D2 + β D4 + γ I (n, n) of a closed contour, rows (β, −α − 4 β, 2 α + 6 β + 1, −α − 4 β, β)."""
    a, b, eye = settings.alpha, settings.beta, np.eye(n)
    return (2 * a + 6 * b + 1) * eye + sum(c * np.roll(eye, s, axis=1) for c, s in ((-a - 4 * b, 1), (-a - 4 * b, -1), (b, 2), (b, -2)))  # type: ignore[no-any-return]


def _gradient(grey: np.ndarray, blur_px: float) -> tuple[np.ndarray, np.ndarray]:
    smooth = cv2.GaussianBlur(np.ascontiguousarray(grey, dtype=np.float32), (0, 0), blur_px)
    return cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)


def _on_edges(xy: np.ndarray, gradient: tuple[np.ndarray, np.ndarray], grey: np.ndarray, settings: ContourSettings) -> Contour:
    """The contour with every vertex at the largest gradient along its normal, and sigmas.  (4), (5)"""
    normal, bent = outward_normals(xy), _curvature(xy)
    xy = xy + np.clip(_division(grey, xy, normal, FINAL_SEARCH_PX), -MAX_FINAL_STEP_PX, MAX_FINAL_STEP_PX)[:, None] * normal
    s = np.arange(-EDGE_SEARCH_PX - 1, EDGE_SEARCH_PX + 2).astype(np.float64)
    across = np.abs(_across(gradient, xy, normal, s))
    best = across[:, 1:-1].argmax(axis=1) + 1
    rows = np.arange(len(xy))
    before, middle, after = (across[rows, best + d] for d in (-1, 0, 1))
    bend = before - 2 * middle + after
    noise = gradient_noise(grey, settings.blur_px)
    on_edge = (bend < 0) & (before <= middle) & (after <= middle) & (middle > EDGE_SIGMAS * noise)
    safe = np.where(on_edge, bend, -1.0)
    width = np.minimum(np.sqrt(middle / -safe), MAX_WIDTH_BLURS * settings.blur_px)
    offset = np.where(on_edge, s[best] + (before - after) / (2 * safe) + bent * width**2 / 2, 0.0)
    texture = _texture(_across(gradient, xy, normal, settings.blur_px * np.array(SIDES)), noise)
    moved = xy + offset[:, None] * normal
    normal = outward_normals(moved)
    sigma = np.hypot(noise / (np.sqrt(2) * -safe), texture * width / (np.sqrt(2 * np.pi) * np.maximum(middle, noise)))
    sigma = np.maximum(np.hypot(sigma, MIN_SIGMA_PX), _roughness(moved, normal))
    sigma = np.where(on_edge, np.minimum(sigma, NO_EDGE_SIGMA_PX), NO_EDGE_SIGMA_PX)
    return Contour(xy_px=moved, normal=normal, sigma_px=sigma, on_edge=on_edge)


def _across(gradient: tuple[np.ndarray, np.ndarray], xy: np.ndarray, normal: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The gradient along the normals (V, S) at the distances `s` (S,) from the vertices."""
    places = xy[:, None] + s[:, None] * normal[:, None]
    return np.asarray(sum(_sample(part, places) * normal[:, None, i] for i, part in enumerate(gradient)))


def _curvature(xy: np.ndarray) -> np.ndarray:
    """Curvature (V,) of a closed polygon [1/px], positive where it is convex, over two vertices on each side."""
    n = outward_normals(xy)
    turn, step = (np.roll(a, -2, axis=0) - np.roll(a, 2, axis=0) for a in (n, xy))
    return np.asarray(np.einsum("ni,ni->n", turn, step) / np.maximum(np.einsum("ni,ni->n", step, step), 1e-9))


def _texture(gradient: np.ndarray, noise: float) -> np.ndarray:
    """σ_t (V,) of (5), both sides combined, from the medians over neighbours of the gradients (V, S) at SIDES."""
    variance = 2 * np.square(_typical(np.abs(gradient))).mean(axis=1)
    return np.sqrt(np.maximum(variance - 2 * noise**2, 0.0))


def _roughness(xy: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Robust scatter (V,) of neighbouring vertices about a smooth curve, which is large where several edges compete."""
    smooth = sum(w * np.roll(xy, d, axis=0) for w, d in zip(SMOOTH, range(-3, 4)))
    residual = np.einsum("ni,ni->n", xy - smooth, normal) / np.sqrt(2 / 3)
    return np.sqrt((1 - OWN_SHARE) * _typical(np.abs(residual)) ** 2 + OWN_SHARE * residual**2)


def _typical(size: np.ndarray) -> np.ndarray:
    """Robust standard deviation of values of these magnitudes (V, ...), from their median over neighbours on the contour."""
    return mad_sigma(np.array([np.roll(size, d, axis=0) for d in range(-NEIGHBOURS, NEIGHBOURS + 1)]), 0)


def gradient_noise(grey: np.ndarray, blur_px: float) -> float:
    """Standard deviation of the blurred gradient from the image's noise σ (Immerkær 1996): σ / (√(8 π) blur²)."""
    response = cv2.filter2D(np.ascontiguousarray(grey, dtype=np.float32), cv2.CV_32F, IMMERKAER)
    sigma = max(MIN_NOISE, float(mad_sigma(response)))
    return float(sigma / (np.sqrt(8 * np.pi) * blur_px**2))


def outward_normals(xy: np.ndarray) -> np.ndarray:
    """Unit normals (V, 2) of a closed polygon, outwards for both orientations."""
    tangent = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    after = np.roll(xy, -1, axis=0)
    turn = np.sign(np.sum(xy[:, 0] * after[:, 1] - after[:, 0] * xy[:, 1])) or 1.0
    normal = turn * np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)


def _sample(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Grey values (V, …) of an image (h, w) float32 at places (V, …, 2), each vertex a row of the look-up."""
    at = np.ascontiguousarray(xy.reshape(len(xy), -1, 2), dtype=np.float32)
    starts = range(0, len(at), LONGEST_LOOK_UP)
    parts = [cv2.remap(image, at[i : i + LONGEST_LOOK_UP], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for i in starts]
    return np.concatenate(parts).reshape(xy.shape[:-1]).astype(np.float64)


HEAD = "frame,vertex,x,y,normal_x,normal_y,sigma,on_edge\n"
COLUMNS = ("x", "y", "normal_x", "normal_y", "sigma", "on_edge")
MAX_VALUE = 1e9  # of a frame's number and of a cell


@dataclass(frozen=True, kw_only=True, slots=True)
class _Place:
    """The position of a frame's rows in the file."""

    start: int
    stop: int
    rows: int


class ContourTable(Mapping[int, Contour]):
    """The outlines by frame. Access to a frame raises InputError if its rows are damaged."""

    def __init__(self, path: Path) -> None:
        """Scan the file for its frames; a missing file has none.

        Raises:
            InputError: the file is damaged.
        """
        self._path = Path(path)
        self._columns: list[str] = []
        self._places: dict[int, _Place] = {}
        if self._path.is_file():
            try:
                self._find_frames()
            except (OSError, ValueError, IndexError, OverflowError) as error:
                raise self._damaged() from error

    def _find_frames(self) -> None:
        with bounded.opened(self._path, bounded.TABLE_BYTES) as file:
            self._columns = [name.strip() for name in file.readline().decode("utf-8").split(",")]
            if not set(COLUMNS) <= set(self._columns):
                raise ValueError("a column is missing")
            column, frame, start, rows = self._columns.index("frame"), None, file.tell(), 0
            while line := file.readline():
                if not line.strip():
                    continue
                here = int(line.split(b",", column + 1)[column])
                if here != frame:
                    self._note(frame, start, file.tell() - len(line), rows)
                    frame, start, rows = here, file.tell() - len(line), 0
                rows += 1
            self._note(frame, start, file.tell(), rows)

    def _note(self, frame: int | None, start: int, stop: int, rows: int) -> None:
        if frame is None:
            return
        if frame in self._places or abs(frame) > MAX_VALUE:
            raise ValueError(f"the rows of frame {frame} are not consecutive")
        self._places[frame] = _Place(start=start, stop=stop, rows=rows)

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[int]:
        return iter(self._places)

    def vertices(self, frame: int) -> int:
        """The number of vertices in a frame."""
        return self._places[frame].rows

    def __getitem__(self, frame: int) -> Contour:
        place = self._places[frame]
        try:
            with bounded.opened(self._path, bounded.TABLE_BYTES) as file:
                file.seek(place.start)
                lines = file.read(place.stop - place.start).decode("utf-8").split("\n")
            rows = [line.rstrip("\r").split(",") for line in lines if line.strip()]
            at = [self._columns.index(name) for name in COLUMNS]
            table = np.array([[float(row[i]) for i in at] for row in rows]).reshape(-1, len(COLUMNS))
        except (OSError, ValueError, IndexError) as error:
            raise self._damaged() from error
        if len(table) != place.rows or not np.isfinite(table).all() or (np.abs(table) > MAX_VALUE).any():
            raise self._damaged()
        return Contour(xy_px=table[:, :2], normal=table[:, 2:4], sigma_px=table[:, 4], on_edge=table[:, 5] > 0)

    def _damaged(self) -> InputError:
        return InputError(f"{self._path} is damaged; run `tricap contour` again.")


class Polygons(Mapping[int, np.ndarray]):
    """The vertices (V, 2) px of a table's outlines by frame, in some frames, of those with at least `least_corners` vertices."""

    def __init__(self, table: ContourTable, frames: Sequence[int], least_corners: int) -> None:
        self._table = table
        self._frames = {frame: None for frame in table if frame in frames and table.vertices(frame) >= least_corners}

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames)

    def __getitem__(self, frame: int) -> np.ndarray:
        if frame not in self._frames:
            raise KeyError(frame)
        return self._table[frame].xy_px


def contour_rows(frame: int, contour: Contour) -> str:
    """The lines of a frame in the file."""
    table = np.column_stack([contour.xy_px, contour.normal, contour.sigma_px])
    return "".join(f"{frame},{v}," + ",".join(f"{x:.4f}" for x in row) + f",{int(contour.on_edge[v])}\n" for v, row in enumerate(table))
