"""Initial values from nothing but the image points and the bar's length: focal lengths, distortion, poses, scale, bar positions.

Pairs of cameras that share most complete bars form a tree. For every pair all guesses of the focal lengths (f_i on a geometric grid,
f_j up to two steps away) and of a common distortion κ are evaluated (`epipolar`); the best sum over the tree is found by dynamic
programming, the best few are adjusted shortly with f, k1 and the poses free, and the one with the smallest robust sum of squares wins.

What is known of a lens before it is calibrated: pseudo-observations that keep unknowns which the data do not determine where lenses are.

The sigmas are generous (a tenth of them would be no surprise), in units that mean the same for every lens: displacement at the image's
corner as a part of its distance from the middle. They matter only where the data say little (SCIENCE §3: "pseudo-observations on each
additional parameter").
"""

from dataclasses import dataclass, replace

import numpy as np

from ..foundation.errors import InputError
from ..geometry.camera import INTERIOR
from .bars import BarObservations, with_bars
from .bundle import Adjusted, Network, Unknowns, adjust
from .epipolar import PAIR_TOLERANCE, PairGuesses, agreeing, sampson, try_guesses, undistorted

RADIAL_SIGMA = (0.5, 0.3, 0.15)  # k1 ρ², k2 ρ⁴, k3 ρ⁶ at the corner, ρ in units of f
DECENTRING_SIGMA = 0.01  # p ρ
AFFINITY_SIGMA = 0.01
MIDDLE_SIGMA = 0.08  # of the image width
FOCAL_SIGMA = 1.5  # of f


def lens_knowledge(size_px: np.ndarray, focal_px: np.ndarray) -> Unknowns:
    """Expected values and sigmas of the interior unknowns of C cameras; all ten free."""
    C = len(size_px)
    expected, sigma = np.zeros((C, len(INTERIOR))), np.ones((C, len(INTERIOR)))
    rho = np.linalg.norm(size_px, axis=1) / 2 / focal_px
    expected[:, 0], sigma[:, 0] = focal_px, FOCAL_SIGMA * focal_px
    expected[:, 1:3], sigma[:, 1:3] = (size_px - 1) / 2, MIDDLE_SIGMA * size_px[:, :1]
    for n, part in enumerate(RADIAL_SIGMA):
        sigma[:, 3 + n] = part / rho ** (2 * n + 2)
    sigma[:, 6:8] = DECENTRING_SIGMA / rho[:, None]
    sigma[:, 8:10] = AFFINITY_SIGMA
    return Unknowns(free=np.ones(len(INTERIOR), dtype=bool), expected=expected, sigma=sigma)


FOCAL_GRID = np.geomspace(0.45, 3.2, 12)  # of the image width
STEPS = (-2, -1, 0, 1, 2)  # f_j of a pair on the grid, from f_i
KAPPAS = (-0.12, -0.06, 0.0, 0.04)
BARS_PER_PAIR, BARS_PER_TRIAL = 60, 120
CANDIDATES = 4
MIN_BARS_PER_PAIR = 6
COARSE_CAUCHY_PX = 3.0
WIDE_GATE, GATE = 12.0, 4.0  # image points further off than this many of these widths take no part, first and then
TILT = np.tan(np.radians(25))

Guesses = dict[tuple[int, int, int], tuple[float, np.ndarray, np.ndarray]]  # (κ, f_i, f_j) by index: score, R, t


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pair:
    """Two cameras and the complete bars on which both agree: positions (m,) and whether camera j has the ends in the other order.

    `singles` (q, 2) are position and end of ends that both see where the other end is missing or wrong.
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


def initial_network(observations: BarObservations, focal_px: float | None = None) -> Adjusted:
    """The best start, adjusted on a part of the positions: its cameras hold for all of them.

    Raises:
        InputError: the cameras share too few bars.
    """
    tree = spanning_tree(observations)
    guesses = {(p.i, p.j): _pair_guesses(observations, p, focal_px) for p in tree}
    best: Adjusted | None = None
    trials = [_trial(observations, tree, network) for network in _starts(observations, tree, guesses, focal_px)]
    for trial in trials:
        if best is None or trial.cost < best.cost:
            best = trial
    assert best is not None
    return best


def spanning_tree(observations: BarObservations) -> list[Pair]:
    """The pairs that join all cameras and share most bars (Prim's algorithm).

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
                f"Camera {', '.join(alone)} and the other cameras see too few of the same bar positions ({count} that agree, "
                f"at least {MIN_BARS_PER_PAIR} are needed); wave the bar where several cameras see both of its ends, and check that "
                "the sequences start at the same instant."
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
        ok = observations.seen[:, i] & observations.seen[:, j]
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
        if len(best[0]) > 0.6 * len(both):
            break
    return Pair(i=i, j=j, positions=both[best[0]], swapped=best[1], singles=np.zeros((0, 2), dtype=int))


def _orders(xi: np.ndarray, xj: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Guesses which end in camera j is which in camera i: as they come; upper with upper; and for cameras on their side."""
    di, dj = xi[:, 0] - xi[:, 1], xj[:, 0] - xj[:, 1]
    orders = [(np.ones(len(di), dtype=bool), np.zeros(len(di), dtype=bool))]
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    for turned in (dj, dj @ quarter, -dj @ quarter, -dj):
        upright = (np.abs(di[:, 1]) > TILT * np.abs(di[:, 0])) & (np.abs(turned[:, 1]) > TILT * np.abs(turned[:, 0]))
        orders.append((upright, np.sign(di[:, 1]) != np.sign(turned[:, 1])))
    return [orders[1], orders[0], *orders[2:]]


def _ordered(xi: np.ndarray, xj: np.ndarray, subset: np.ndarray, swapped: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the bars that agree when `subset` is ordered by `swapped`, and the order of each, all bars tried both ways at the end."""
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
        return focal_px * np.array([0.75, 0.87, 1.0, 1.15, 1.33])
    return FOCAL_GRID * float(np.median(observations.size_px[:, 0]))


def _starts(
    observations: BarObservations, tree: list[Pair], guesses: dict[tuple[int, int], Guesses], focal_px: float | None
) -> list[Network]:
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
    """Smallest sum of scores of the pairs below a camera whose focal length is a; what was chosen is noted."""
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
) -> Network:
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
    return Network(interior=interior, R=R, t=t, middle=empty, direction=empty, length_m=observations.length_m)


def _trial(observations: BarObservations, tree: list[Pair], network: Network) -> Adjusted:
    """A short robust adjustment of f, k1 and the poses on bars that the pairs of the tree agree on."""
    part = trial_part(observations, tree)
    knowledge = lens_knowledge(part.size_px, network.interior[:, 0]).only("f", "k1")
    for gate in (WIDE_GATE, GATE):
        network, used = with_bars(network, part, gate * COARSE_CAUCHY_PX)
        done = adjust(network, part.xy_px, used, knowledge, cauchy_px=COARSE_CAUCHY_PX, unit_px=0.3, max_iterations=8, tolerance=1e-2)
        network = done.network
    left_out = int(part.seen.sum() - used.sum())  # what does not fit must not make a start look better
    return replace(done, cost=done.cost + left_out * COARSE_CAUCHY_PX**2 * float(np.log1p(GATE**2)))


def trial_part(observations: BarObservations, tree: list[Pair]) -> BarObservations:
    """Labelled positions on which the pairs of the tree agree: `BARS_PER_TRIAL` that all cameras see, or what each pair sees besides.

    The order of the ends is told along the tree from any camera that sees a position, so cameras need not have one position in common.
    """
    N, C = len(observations.xy_px), len(observations.names)
    joined_to = np.tile(np.arange(C), (N, 1))  # the first camera of the chain by which a position is seen
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
    """At most `count` of the positions, evenly over the time."""
    return positions[np.unique(np.linspace(0, len(positions) - 1, count).astype(int))] if len(positions) else positions
