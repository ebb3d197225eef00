"""Sub-pixel sampling: the quintic B-spline through the grey values (Unser 1999, doi:10.1109/79.799930).

The exact spline is computed on a grid four times as fine, in tiles, where it is sampled first; a sample is a bilinear look-up in that grid.
A tile depends on the image alone, so it does not matter who needs it first. With f the grey values of the tile and of a margin about it,

    fine = U f Uᵀ ,   U_ij = η(i/4 − j) ,   η the cardinal spline, which falls below 10⁻⁶ within the margin              (1)

 On real speckle (DIC Challenge, sample 5) matching has a bias of 0.0009 px with it, 0.0027 px
with the cubic spline, which takes as long to prepare. OpenCV 4 rounds the position of a look-up to 1/32 of the fine grid, at most
0.0039 px, which averages out over a patch. OpenCV 5, which ships, is exact.
"""

from collections.abc import Iterable
from functools import cache, cached_property

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..geometry.robust import mad_sigma

FINENESS = 4  # of the grid, per pixel
ORDER = 5  # of the spline
IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32) / 6  # unit response to white noise
MIN_NOISE = 0.3  # grey values: rounding alone
SATURATED = 0.02  # of 255: grey values this close to black or white
FEWEST_PIXELS = 100  # for an estimate of the noise
TILE = 32  # px, side of a tile
MARGIN = 18  # px about it: the cardinal spline falls by 0.43 from pixel to pixel
LOOK_UP_PX = 0.5  # px beyond a sample that its look-up may reach
NOISE_PIXELS = 100_000  # that an estimate of the noise needs; of larger images only some rows are used
LONGEST_LOOK_UP = 32_000  # rows; OpenCV takes at most 32,766


class SplineImage:
    """An image that can be sampled between its pixels. `shape` is (h, w), `smoothing` (2,) the sigmas of its smoothing in x and y."""

    def __init__(self, image: np.ndarray, *, smoothing: tuple[float, float] = (0.0, 0.0)) -> None:
        grey = np.ascontiguousarray(image, dtype=np.float32)
        h, w = grey.shape
        self.smoothing = smoothing
        self._grey, self._smoothed = grey, dict[tuple[float, float], SplineImage]()
        self.shape: tuple[int, int] = (h, w)
        self._wide = cv2.copyMakeBorder(grey, MARGIN, MARGIN + TILE, MARGIN, MARGIN + TILE, cv2.BORDER_REFLECT_101)
        self._fine = np.zeros(((h - 1) * FINENESS + 1, (w - 1) * FINENESS + 1), np.float32)  # takes memory where a tile is written
        self._ready = np.zeros((-(-h // TILE), -(-w // TILE)), dtype=bool)
        self._ready_about = np.zeros((2 * self._ready.shape[0], 2 * self._ready.shape[1]), dtype=bool)  # half tiles, and those around them
        self._pixels: np.ndarray | None = None  # (3, h, w) grey values and gradients, on request

    @property
    def grey(self) -> np.ndarray:
        """The image (h, w) float32."""
        return self._grey

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the grey values' noise."""
        return noise_sigma(self._grey)

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Grey values (n, m) float32 at columns x and rows y (n, m) float32; beyond the border the image is mirrored.

        m stays below 32,767, and so does four times the image's width and height (limits of the look-up).
        """
        if not x.size:
            return np.zeros(x.shape, np.float32)
        if len(x) > LONGEST_LOOK_UP:
            starts = range(0, len(x), LONGEST_LOOK_UP)
            return np.concatenate([self.sample(x[i : i + LONGEST_LOOK_UP], y[i : i + LONGEST_LOOK_UP]) for i in starts])
        self._prepare((x.min(), y.min()), (x.max(), y.max()))
        return cv2.remap(
            self._fine, x * np.float32(FINENESS), y * np.float32(FINENESS), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
        )

    def look_up(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Grey values (n, m) float32 like `sample`, bilinear between the pixels: for a search that is refined afterwards."""
        if len(x) > LONGEST_LOOK_UP:
            starts = range(0, len(x), LONGEST_LOOK_UP)
            return np.concatenate([self.look_up(x[i : i + LONGEST_LOOK_UP], y[i : i + LONGEST_LOOK_UP]) for i in starts])
        return cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101) if x.size else np.zeros(x.shape, np.float32)

    def sample_patches(self, centre: np.ndarray, shape: np.ndarray, basis: np.ndarray) -> np.ndarray:
        """Grey values (N, n) float32 of patches: the points centre + shape · (u, v), `basis` (3, n) float32 holding rows 1, u, v.

        `centre` (N, 2) and `shape` (N, 2, 2) in pixels; N and n stay below 32,767.
        """
        self._prepare_about(centre, np.abs(shape) @ np.abs(basis[1:]).max(axis=1))
        warp = np.empty((2, len(centre), 3), np.float32)
        warp[:, :, 0], warp[:, :, 1:] = FINENESS * centre.T, FINENESS * shape.transpose(1, 0, 2)
        x, y = (warp.reshape(-1, 3) @ basis).reshape(2, len(centre), -1)
        return cv2.remap(self._fine, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)

    def around(self, xy: np.ndarray, half: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Upright patches (N, n) float32 about whole pixels (N, 2), and their gradients by fourth-order central differences.

        `half` (w, h) is half their size. A patch that extends beyond the image is moved into it.
        """
        if self._pixels is None:
            grey = self._grey
            wide = cv2.copyMakeBorder(grey, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)
            step = wide.shape[1]
            self._pixels = np.stack([grey, *(difference(wide, s).reshape(wide.shape)[2:-2, 2:-2] for s in (1, step))])
        (w, h), (rows, columns) = half, self.shape
        corner = np.clip(xy - half, 0, (columns - 1 - 2 * w, rows - 1 - 2 * h))
        windows = [sliding_window_view(values, (2 * h + 1, 2 * w + 1)) for values in self._pixels]
        f, fx, fy = (window[corner[:, 1], corner[:, 0]].reshape(len(xy), (2 * h + 1) * (2 * w + 1)) for window in windows)
        return f, fx, fy

    def _prepare(self, low: Iterable[float], high: Iterable[float]) -> None:
        """Compute the tiles of the box from `low` to `high` (x, y), as far as they are not ready."""
        columns, rows = (_tiles(float(a), float(b), size) for a, b, size in zip(low, high, self.shape[::-1]))
        missing = ~self._ready[rows, columns]
        if missing.any():
            self._compute(np.argwhere(missing) + (rows.start, columns.start))

    def _prepare_about(self, centre: np.ndarray, reach: np.ndarray) -> None:
        """Compute the tiles of patches about `centre` (N, 2) that reach so far (N, 2), as far as they are not ready; none between them."""
        h, w = self.shape
        usual = (reach <= TILE / 2 - LOOK_UP_PX) & (centre >= 0) & (centre <= (w - 1, h - 1))
        if not usual.all():
            usual = usual.all(axis=1)
            for low, high in zip(centre[~usual] - reach[~usual], centre[~usual] + reach[~usual]):
                self._prepare(low, high)
            centre = centre[usual]
        i, j = (centre.T * (2 / TILE)).astype(np.intp)  # in half tiles: what a patch needs lies between half a tile before it and behind it
        ready = self._ready_about[j, i]
        if ready.all():
            return
        i, j = i[~ready], j[~ready]
        missing, (rows, columns) = np.zeros_like(self._ready), self._ready.shape
        for r in ((j - 1) // 2, (j + 2) // 2, (j + 1) // 2):
            for c in ((i - 1) // 2, (i + 2) // 2, (i + 1) // 2):
                missing[np.clip(r, 0, rows - 1), np.clip(c, 0, columns - 1)] = True
        self._compute(np.argwhere(missing & ~self._ready))
        self._ready_about[j, i] = True

    def _compute(self, tiles: np.ndarray) -> None:
        """Compute tiles (n, 2) by row and column. Two threads may compute one, with the same values."""
        U = _interpolation()
        for r, c in tiles.tolist():
            f = self._wide[r * TILE : (r + 1) * TILE + 2 * MARGIN, c * TILE : (c + 1) * TILE + 2 * MARGIN]
            target = self._fine[r * TILE * FINENESS :, c * TILE * FINENESS :][: TILE * FINENESS, : TILE * FINENESS]
            target[...] = (U @ f @ U.T)[: target.shape[0], : target.shape[1]]  # (1)
            self._ready[r, c] = True

    def smoothed(self, sigma_px: float, row_step: int) -> "SplineImage":
        """The image after a Gaussian of `sigma_px` full-frame pixels (a field's rows are `row_step` of them); cached."""
        sigma = (sigma_px, sigma_px / row_step)
        if sigma not in self._smoothed:
            size = (_width(sigma[0]), _width(sigma[1]))
            grey = cv2.GaussianBlur(self._grey, size, sigmaX=sigma[0], sigmaY=sigma[1], borderType=cv2.BORDER_REFLECT_101)
            both = np.hypot(self.smoothing, sigma).tolist()
            self._smoothed[sigma] = SplineImage(grey, smoothing=(both[0], both[1]))
        return self._smoothed[sigma]

    def inside(self, xy: np.ndarray, margin: np.ndarray | float) -> np.ndarray:
        """Whether points (…, 2) lie inside the image by at least `margin` pixels; NaN does not."""
        h, w = self.shape
        mx, my = margin if isinstance(margin, np.ndarray) else (margin, margin)
        x, y = xy[..., 0], xy[..., 1]
        with np.errstate(invalid="ignore"):
            return np.asarray((x >= mx) & (y >= my) & (x <= w - 1 - mx) & (y <= h - 1 - my))


def difference(values: np.ndarray, step: int) -> np.ndarray:
    """Central differences of fourth order from the values `step` and 2 `step` away in the flattened array; zero at its ends."""
    p = values.reshape(-1)
    out = np.zeros(p.size, np.float32)
    if p.size > 4 * step:
        near, far = out[2 * step : -2 * step], p[4 * step :] - p[: -4 * step]
        np.subtract(p[3 * step : -step], p[step : -3 * step], out=near)
        near *= np.float32(2 / 3)
        far *= np.float32(1 / 12)
        near -= far
    return out


def correlated_noise(fx: np.ndarray, fy: np.ndarray, smoothing: tuple[float, float]) -> np.ndarray:
    """(N,) how many times larger the variance of a match with gradients fx, fy (N, h, w) is for smoothed noise than for white noise.

    Smoothed noise has the autocorrelation R of the Gaussian's kernel, about exp(−|Δ|²/(4 σ²)): the covariance is the sandwich (AᵀA)⁻¹ AᵀRA
    (AᵀA)⁻¹, taken by the trace of its middle.
    """
    if not any(smoothing):
        return np.ones(len(fx))
    R_columns, R_rows = (_autocorrelation(n, s) for n, s in zip((fx.shape[2], fx.shape[1]), smoothing))
    spread = sum(np.einsum("nij,nij->n", f, R_rows @ (f @ R_columns)) for f in (fx, fy))
    power = sum(np.einsum("nij,nij->n", f, f) for f in (fx, fy))
    return np.maximum(1.0, spread.astype(np.float64) / np.maximum(power, 1e-9))


def _autocorrelation(n: int, sigma_px: float) -> np.ndarray:
    """Correlations (n, n) of n neighbouring pixels of white noise after the Gaussian."""
    kernel = cv2.getGaussianKernel(_width(sigma_px), sigma_px).ravel()
    shifts = np.zeros(n + len(kernel))
    shifts[: len(kernel)] = np.correlate(kernel, kernel, "full")[len(kernel) - 1 :] / np.sum(kernel**2)
    return shifts[np.abs(np.arange(n)[:, None] - np.arange(n))].astype(np.float32)


def _width(sigma_px: float) -> int:
    """Taps of a Gaussian that reaches four sigmas to either side."""
    return 2 * round(4 * sigma_px) + 1


def noise_sigma(image: np.ndarray) -> float:
    """Standard deviation of the sensor's noise [grey values], from residuals of a local plane; at least that of rounding.

    Second differences (Immerkær 1996, doi:10.1006/cviu.1996.0060); their median excludes texture as long as half of the image is smooth
    at the scale of a pixel. Saturated pixels have no noise.
    """
    g = np.asarray(image, dtype=np.float32)
    some = slice(1, -1, max(1, g.size // NOISE_PIXELS))
    inner = g[some, 1:-1]
    usable = (inner > SATURATED * 255) & (inner < max(255.0, float(g.max())) - SATURATED * 255)
    residual = cv2.filter2D(g, cv2.CV_32F, IMMERKAER)[some, 1:-1][usable]
    return max(MIN_NOISE, float(mad_sigma(residual))) if residual.size > FEWEST_PIXELS else MIN_NOISE


@cache
def _interpolation() -> np.ndarray:
    """U (4 TILE, TILE + 2 MARGIN) of (1) in single precision; rows sum to 1."""
    from scipy.interpolate import BSpline
    from scipy.ndimage import spline_filter1d

    impulse = np.zeros(8 * MARGIN + 1)
    impulse[4 * MARGIN] = 1.0
    coefficients = spline_filter1d(impulse, order=ORDER, mode="mirror")
    half = (ORDER + 1) / 2
    basis = BSpline.basis_element(np.arange(-half, half + 1), extrapolate=False)
    places = np.arange(-4 * MARGIN, 4 * MARGIN + 1)
    at = np.arange(FINENESS * TILE)[:, None] / FINENESS - (np.arange(TILE + 2 * MARGIN) - MARGIN)
    U = np.nan_to_num(basis(at[..., None] - places)) @ coefficients
    U[np.abs(at) > MARGIN] = 0.0
    return np.ascontiguousarray(U / U.sum(axis=1, keepdims=True), dtype=np.float32)


def _tiles(low: float, high: float, size: int) -> slice:
    """The tiles of a range of pixels along an axis of `size` pixels; what lies beyond the border is mirrored."""
    last = float(size - 1)
    if not low - LOOK_UP_PX >= -last or not high + LOOK_UP_PX <= 2 * last:  # also of NaN
        return slice(0, int(last // TILE) + 1)
    low, high = low - LOOK_UP_PX, high + LOOK_UP_PX
    first = max(min(low, 2 * last - high), 0.0)
    final = max(min(max(high, -low), last), first)
    return slice(int(first // TILE), int(final // TILE) + 1)
