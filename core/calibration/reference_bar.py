"""Initial values from nothing but the image points and the length of the bar: focal lengths, distortion, poses, scale, bar positions.

The pairs of cameras that share most complete bars form a tree. For every pair all guesses of the focal lengths (f_i on a geometric grid,
f_j up to two steps away) and of a common distortion κ are evaluated (`epipolar`); the best sum over the tree is found by dynamic
programming, the best few are adjusted briefly with f, k1 and the poses free, and the one with the smallest robust sum of squares wins.

`lens_prior` gives the pseudo-observations of the interior unknowns (D'Apuzzo et al. 2000, §2.2, and Brown 1971 for the parameters). They
keep unknowns that the data do not determine within what lenses have. The sigmas are generous (a tenth of them is no surprise), in units
that mean the same for every lens: displacement at the image corner relative to its distance from the centre.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..foundation.errors import InputError
from ..geometry.camera import INTERIOR
from .bars import PAIR_TOLERANCE, BarObservations, PairGuesses, agreeing, sampson, try_guesses, undistorted, with_bars
from .bundle import FIXED_SIGMA, Adjusted, LevenbergMarquardt, Unknowns, adjust
from .network import BarNetwork

FOCAL_GRID = np.geomspace(0.45, 3.2, 12)  # of the image width
ROUGH_FOCALS = np.array([0.75, 0.87, 1.0, 1.15, 1.33])  # of a given rough focal length
STEPS = (-2, -1, 0, 1, 2)  # of f_j on the grid, from f_i
KAPPAS = (-0.12, -0.06, 0.0, 0.04)  # radial distortion at the image corner
BARS_PER_PAIR = 60
BARS_PER_TRIAL = 120
CANDIDATES = 4  # starts that are adjusted
MIN_BARS_PER_PAIR = 6
ENOUGH_BARS = 0.6  # of the shared bars: no other order of the ends is tried
COARSE_CAUCHY_PX = 3.0
WIDE_GATE = 12.0  # of these widths: image points further off are not used in the first adjustment of a trial
GATE = 4.0  # of these widths, in the second
TILT = np.tan(np.radians(25))  # of a bar that is upright in the image
RADIAL_SIGMA = (0.5, 0.3, 0.15)  # k1 ρ², k2 ρ⁴, k3 ρ⁶ at the corner, ρ in units of f
DECENTRING_SIGMA = 0.01  # p ρ
AFFINITY_SIGMA = 0.01
CENTRE_SIGMA = 0.08  # of the image width
FOCAL_SIGMA = 1.5  # of f

Guesses = dict[tuple[int, int, int], tuple[float, np.ndarray, np.ndarray]]  # (κ, f_i, f_j) by index: score, R, t


def lens_prior(size_px: np.ndarray, focal_px: np.ndarray, fisheye: np.ndarray | bool = False) -> Unknowns:
    """The prior of the interior unknowns of C cameras, with all ten free; what a `fisheye` lens (C,) does not have is fixed at 0."""
    C = len(size_px)
    expected, sigma = np.zeros((C, len(INTERIOR))), np.ones((C, len(INTERIOR)))
    rho = np.linalg.norm(size_px, axis=1) / 2 / focal_px
    expected[:, 0], sigma[:, 0] = focal_px, FOCAL_SIGMA * focal_px
    expected[:, 1:3], sigma[:, 1:3] = (size_px - 1) / 2, CENTRE_SIGMA * size_px[:, :1]
    for n, part in enumerate(RADIAL_SIGMA):
        sigma[:, 3 + n] = part / rho ** (2 * n + 2)
    sigma[:, 6:8] = DECENTRING_SIGMA / rho[:, None]
    curved = np.broadcast_to(fisheye, C)
    sigma[curved, 6], sigma[curved, 7] = RADIAL_SIGMA[-1] / rho[curved] ** 8, FIXED_SIGMA
    sigma[:, 8:10] = AFFINITY_SIGMA
    return Unknowns(free=np.ones(len(INTERIOR), dtype=bool), expected=expected, sigma=sigma)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pair:
    """Two cameras and the complete bars on which both agree: positions (m,), and whether the ends are swapped in camera j.

    `singles` (q, 2) are position and end of ends visible in both cameras where the other end is missing or wrong.
    """

    i: int
    j: int
    positions: np.ndarray
    swapped: np.ndarray
    singles: np.ndarray

    def points(self, observations: BarObservations) -> tuple[np.ndarray, np.ndarray, int]:
        """Image points (n, 2) of both cameras, those of complete bars first, and the number of these bars."""
        some = np.unique(np.linspace(0, len(self.positions) - 1, BARS_PER_PAIR).astype(int))
        at, swapped = self.positions[some], self.swapped[some]
        xi, xj = observations.xy_px[at, self.i], observations.xy_px[at, self.j]
        xj = np.where(swapped[:, None, None], xj[:, ::-1], xj)
        n, e = self.singles[: max(0, 2 * (BARS_PER_PAIR - len(at)))].T
        xi = np.concatenate([xi.reshape(-1, 2), observations.xy_px[n, self.i, e]])
        xj = np.concatenate([xj.reshape(-1, 2), observations.xy_px[n, self.j, e]])
        return xi, xj, len(at)


def initial_network(observations: BarObservations, focal_px: float | None = None) -> Adjusted[BarNetwork]:
    """The best start, adjusted on a part of the positions.

    Raises:
        InputError: the cameras share too few bars.
    """
    tree = spanning_tree(observations)
    guesses = {(p.i, p.j): _pair_guesses(observations, p, focal_px) for p in tree}
    best: Adjusted[BarNetwork] | None = None
    trials = [_trial(observations, tree, network) for network in _starts(observations, tree, guesses, focal_px)]
    for trial in trials:
        if best is None or trial.cost < best.cost:
            best = trial
    assert best is not None
    return best


def spanning_tree(observations: BarObservations) -> list[Pair]:
    """The pairs that connect all cameras and share most bars (Prim's algorithm).

    Raises:
        InputError: a camera shares too few bars with the others.
    """
    C = len(observations.names)
    pairs = {(i, j): shared_bars(observations, i, j) for i in range(C) for j in range(i + 1, C)}
    joined = [int(np.argmax([sum(len(p.positions) for k, p in pairs.items() if c in k) for c in range(C)]))]
    tree: list[Pair] = []
    while len(joined) < C:
        edges = [(len(p.positions), k) for k, p in pairs.items() if (k[0] in joined) != (k[1] in joined)]
        count, (i, j) = max(edges)
        if count < MIN_BARS_PER_PAIR:
            alone = [observations.names[c] for c in range(C) if c not in joined]
            raise InputError(
                f"Camera {', '.join(alone)} shares too few bar positions with the other cameras ({count} that agree, "
                f"at least {MIN_BARS_PER_PAIR} are needed); wave the bar where both of its ends are visible to several cameras, and check "
                "that the sequences start at the same instant."
            )
        pair = pairs[i, j]
        if j in joined:
            pair = Pair(i=j, j=i, positions=pair.positions, swapped=pair.swapped, singles=pair.singles)
        tree.append(pair)
        joined.append(pair.j)
    return tree


def shared_bars(observations: BarObservations, i: int, j: int) -> Pair:
    """The positions whose two ends agree with one epipolar geometry of cameras i and j, with the order of the ends resolved."""
    width = float(observations.size_px[[i, j], 0].max())
    if observations.labelled:
        ok = observations.visible[:, i] & observations.visible[:, j]
        ok[ok] = agreeing(observations.xy_px[:, i][ok], observations.xy_px[:, j][ok], width)[0]
        good = ok.all(axis=1)
        singles = np.argwhere(ok & ~good[:, None])
        return Pair(i=i, j=j, positions=np.flatnonzero(good), swapped=np.zeros(good.sum(), dtype=bool), singles=singles)
    both = np.flatnonzero(observations.complete[:, i] & observations.complete[:, j])
    xi, xj = observations.xy_px[both, i], observations.xy_px[both, j]
    best = np.zeros(0, dtype=int), np.zeros(0, dtype=bool)
    for subset, swapped in _orders(xi, xj):
        found = _ordered(xi, xj, subset, swapped, width)
        if len(found[0]) > len(best[0]):
            best = found
        if len(best[0]) > ENOUGH_BARS * len(both):
            break
    return Pair(i=i, j=j, positions=both[best[0]], swapped=best[1], singles=np.zeros((0, 2), dtype=int))


def _orders(xi: np.ndarray, xj: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Guesses of the order of the ends in camera j: as they are; upper with upper; and for cameras turned on their side."""
    di, dj = xi[:, 0] - xi[:, 1], xj[:, 0] - xj[:, 1]
    orders = [(np.ones(len(di), dtype=bool), np.zeros(len(di), dtype=bool))]
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    for turned in (dj, dj @ quarter, -dj @ quarter, -dj):
        upright = (np.abs(di[:, 1]) > TILT * np.abs(di[:, 0])) & (np.abs(turned[:, 1]) > TILT * np.abs(turned[:, 0]))
        orders.append((upright, np.sign(di[:, 1]) != np.sign(turned[:, 1])))
    return [orders[1], orders[0], *orders[2:]]


def _ordered(xi: np.ndarray, xj: np.ndarray, subset: np.ndarray, swapped: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the bars that agree when `subset` is ordered by `swapped`, and the order of each bar."""
    ordered = np.where(swapped[:, None, None], xj[:, ::-1], xj)
    ok, F = agreeing(xi[subset].reshape(-1, 2), ordered[subset].reshape(-1, 2), width)
    if not ok.any():
        return np.zeros(0, dtype=int), np.zeros(0, dtype=bool)
    straight = sampson(F, xi, xj).max(axis=1)
    crossed = sampson(F, xi, xj[:, ::-1]).max(axis=1)
    good = (np.minimum(straight, crossed) < 0.5 * PAIR_TOLERANCE * width) & (np.maximum(straight, crossed) > 2 * PAIR_TOLERANCE * width)
    return np.flatnonzero(good), (crossed < straight)[good]


def _pair_guesses(observations: BarObservations, pair: Pair, focal_px: float | None) -> Guesses:
    """Score, R and t of every guess (κ, f_i, f_j by their indices)."""
    grid = _grid(observations, focal_px)
    index = [(a, a + s) for a in range(len(grid)) for s in STEPS if 0 <= a + s < len(grid)]
    fi, fj = grid[[a for a, _ in index]], grid[[b for _, b in index]]
    xi, xj, bars = pair.points(observations)
    table = {}
    for k, kappa in enumerate(KAPPAS):
        ui, uj = undistorted(xi, observations.size_px[pair.i], kappa), undistorted(xj, observations.size_px[pair.j], kappa)
        tried: PairGuesses = try_guesses(ui, uj, bars, fi, fj, observations.length_m)
        for n, (a, b) in enumerate(index):
            table[k, a, b] = (float(tried.score[n]), tried.R[n], tried.t_m[n])
    return table


def _grid(observations: BarObservations, focal_px: float | None) -> np.ndarray:
    if focal_px is not None:
        return focal_px * ROUGH_FOCALS
    return FOCAL_GRID * float(np.median(observations.size_px[:, 0]))


def _starts(
    observations: BarObservations, tree: list[Pair], guesses: dict[tuple[int, int], Guesses], focal_px: float | None
) -> list[BarNetwork]:
    """Networks without bars of the best guesses, one per focal length of the first camera and κ."""
    grid = _grid(observations, focal_px)
    root = tree[0].i
    ranked = []
    for k in range(len(KAPPAS)):
        for a in range(len(grid)):
            chosen: dict[int, int] = {root: a}
            ranked.append((_best_below(tree, guesses, root, k, a, len(grid), chosen), k, a, chosen))
    ranked.sort(key=lambda entry: entry[0])
    return [_chained(observations, tree, guesses, k, chosen, grid) for _, k, _, chosen in ranked[:CANDIDATES]]


def _best_below(
    tree: list[Pair], guesses: dict[tuple[int, int], Guesses], camera: int, k: int, a: int, grid: int, chosen: dict[int, int]
) -> float:
    """Smallest sum of the scores of the pairs below a camera with focal length a; the choices are added to `chosen`."""
    total = 0.0
    for pair in (p for p in tree if p.i == camera):
        best, below = np.inf, {}
        for b in (a + s for s in STEPS if 0 <= a + s < grid):
            deeper: dict[int, int] = {pair.j: b}
            score = guesses[pair.i, pair.j][k, a, b][0] + _best_below(tree, guesses, pair.j, k, b, grid, deeper)
            if score < best:
                best, below = score, deeper
        chosen.update(below)
        total += best
    return total


def _chained(
    observations: BarObservations,
    tree: list[Pair],
    guesses: dict[tuple[int, int], Guesses],
    k: int,
    chosen: dict[int, int],
    grid: np.ndarray,
) -> BarNetwork:
    C = len(observations.names)
    interior = np.zeros((C, len(INTERIOR)))
    R, t = np.tile(np.eye(3), (C, 1, 1)), np.zeros((C, 3))
    for c in range(C):
        size = observations.size_px[c]
        f = grid[chosen[c]]
        interior[c, :3] = f, (size[0] - 1) / 2, (size[1] - 1) / 2
        interior[c, 3] = KAPPAS[k] / (float(size @ size) / 4 / f**2)
    for pair in tree:  # parents come before their children
        _, R_ij, t_ij = guesses[pair.i, pair.j][k, chosen[pair.i], chosen[pair.j]]
        R[pair.j], t[pair.j] = R_ij @ R[pair.i], R_ij @ t[pair.i] + t_ij
    empty = np.zeros((0, 3))
    return BarNetwork(interior=interior, R=R, t=t, middle=empty, direction=empty, length_m=observations.length_m)


def _trial(observations: BarObservations, tree: list[Pair], network: BarNetwork) -> Adjusted[BarNetwork]:
    """A short robust adjustment of f, k1 and the poses on bars on which the pairs of the tree agree."""
    part = trial_part(observations, tree)
    prior = lens_prior(part.size_px, network.interior[:, 0]).only("f", "k1")
    for gate in (WIDE_GATE, GATE):
        network, used = with_bars(network, part, gate * COARSE_CAUCHY_PX)
        done = adjust(
            network,
            part.xy_px,
            used,
            prior,
            cauchy_px=COARSE_CAUCHY_PX,
            unit_px=0.3,
            iteration=LevenbergMarquardt(max_iterations=8, tolerance=1e-2),
        )
        network = done.network
    left_out = int(part.visible.sum() - used.sum())  # points that do not fit must not improve the cost of a start
    return replace(done, cost=done.cost + left_out * COARSE_CAUCHY_PX**2 * float(np.log1p(GATE**2)))


def trial_part(observations: BarObservations, tree: list[Pair]) -> BarObservations:
    """Labelled positions on which the pairs of the tree agree: `BARS_PER_TRIAL` visible to all cameras, else further ones of each pair.

    The order of the ends is passed along the tree from any camera that shows a position, so no position needs to be visible to all cameras.
    """
    N, C = len(observations.xy_px), len(observations.names)
    joined_to = np.tile(np.arange(C), (N, 1))  # the first camera of the chain in which a position is visible
    flipped = np.zeros((N, C), dtype=bool)
    for pair in tree:  # parents come before their children
        joined_to[pair.positions, pair.j] = joined_to[pair.positions, pair.i]
        flipped[pair.positions, pair.j] = flipped[pair.positions, pair.i] ^ pair.swapped
    size = (joined_to[:, :, None] == np.arange(C)).sum(axis=1)  # (N, C) cameras in the chain of each
    known = joined_to == size.argmax(axis=1)[:, None]
    xy = np.where(flipped[..., None, None], observations.xy_px[:, :, ::-1], observations.xy_px)
    xy = np.where(known[..., None, None], xy, np.nan)
    some = _spread(np.flatnonzero(known.all(axis=1)), BARS_PER_TRIAL)
    if len(some) < BARS_PER_TRIAL:
        each = -(-BARS_PER_TRIAL // len(tree))
        some = np.unique(np.concatenate([some, *(_spread(np.flatnonzero(known[:, p.i] & known[:, p.j]), each) for p in tree)]))
    return observations.changed(xy[some], observations.frames[some])


def _spread(positions: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of the positions, evenly spread over time."""
    return positions[np.unique(np.linspace(0, len(positions) - 1, count).astype(int))] if len(positions) else positions
