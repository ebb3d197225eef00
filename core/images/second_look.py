"""Which of two looks of a cell is the background, and which is a part of somebody who stood there for much of a clip.

A cell that was covered for most of a clip has two looks, and the more frequent one is not the background's. The background, however,
goes on beyond the outline of what stood before it, and measured points lie on the person:

    E = Σ_i u_i(l_i) + Σ_ij clip((g_i(l_i) − g_j(l_j))² / 2σ² − F, 0, T) ,   u_i(l) = s n_i(l) − p ln m_i(l)                (1)

l is the look of each cell, g its grey value, σ the spread of the differences of neighbours in this view, m the number of images with that
look, and n of those in which points of the person were measured there. Differences that are usual cost nothing (F): otherwise plain cloth
would be a better background than a wall with texture. p is small: the cells of a leg are one event. Background estimation as a labelling
of all pixels: Cohen (2005, Proc. ICCV, 1034-1041); E is minimised by min-sum belief propagation (Felzenszwalb & Huttenlocher 2006, Int. J.
Comput. Vis. 70:41-54).
"""

from collections.abc import Sequence

import numpy as np

from ..geometry.robust import mad_sigma

FREE, TRUNCATION = 2.0, 4.0  # F and T of (1)
FREQUENT = 0.1  # p of (1)
SEEN_COST, MOST_SEEN = 1.0, 4.0  # s of (1) for each image, and at most
ROUNDS, DAMPING = 60, 0.5
CLEAR = 2.0  # by so much E must be less with the less frequent look
NEVER = 1e3  # cost of a look that a cell does not have
SIDES = ((0, 1), (1, 0))  # pairs of neighbours: along rows, along columns


def look_cost(count: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """u (h, w) of a look that cells have in `count` images, in `measured` of which points lie there; `NEVER` without any."""
    return np.where(count > 0, np.minimum(SEEN_COST * measured, MOST_SEEN) - FREQUENT * np.log(np.maximum(count, 1)), NEVER)


def second_is_background(
    first: np.ndarray, second: np.ndarray, first_cost: np.ndarray, second_cost: np.ndarray, noise: float
) -> np.ndarray:
    """E (h, w) of the first look less that of the second, in grey values (h, w) with u; infinite in favour of the only look.

    Above `CLEAR` the second look is the background, below 0 the first, and between them it is not known.
    """
    two = second_cost < NEVER
    gain = np.full(first.shape, -np.inf)
    if not two.any():
        return gain
    rows, columns = (np.flatnonzero(two.any(axis=axis)) for axis in (1, 0))
    box = tuple(slice(max(int(at[0]) - 1, 0), int(at[-1]) + 2) for at in (rows, columns))
    spread = max(noise, *(mad_sigma(np.diff(first, axis=axis)) for axis in (0, 1)))
    looks = np.stack([first[box], np.where(two, second, first)[box]])
    energy = _propagated(np.stack([first_cost[box], second_cost[box]]), looks / spread)
    gain[box] = np.where(two[box], energy[0] - energy[1], -np.inf)
    return gain


def _propagated(unary: np.ndarray, looks: np.ndarray) -> np.ndarray:
    """The least E (2, h, w) for each look of each cell, of unary costs and of looks over their spread (2, h, w)."""
    ends = [_ends(looks, side) for side in SIDES]
    pairs = [np.clip((first[:, None] - last) ** 2 / 2 - FREE, 0.0, TRUNCATION) for first, last in ends]  # (2, 2, …): looks of both
    messages = [[np.zeros(first.shape) for _ in range(2)] for first, _ in ends]  # to the second cell of each pair, and to the first
    for _ in range(ROUNDS):
        total = _total(unary, messages)
        for side, pair, (onwards, back) in zip(SIDES, pairs, messages):
            first, last = (end.copy() for end in _ends(total, side))
            first -= back
            last -= onwards
            _send(onwards, first[0] + pair[0], first[1] + pair[1])
            _send(back, last[0] + pair[:, 0], last[1] + pair[:, 1])
    return _total(unary, messages)


def _send(message: np.ndarray, with_first: np.ndarray, with_second: np.ndarray) -> None:
    """Renew a message (2, …) by the costs of its looks with each look of the sender."""
    new = np.minimum(with_first, with_second)
    message += DAMPING * (new - np.minimum(new[0], new[1]) - message)


def _total(unary: np.ndarray, messages: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    total = unary.copy()
    for side, (onwards, back) in zip(SIDES, messages):
        first, last = _ends(total, side)
        first += back
        last += onwards
    return total


def _ends(of_cells: np.ndarray, side: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The first and the second cells (2, …) of pairs of neighbours, as views."""
    down, right = side
    h, w = of_cells.shape[1:]
    return of_cells[:, : h - down, : w - right], of_cells[:, down:, right:]
