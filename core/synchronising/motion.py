"""When somebody moves in a view: which starts bring the motion of two recordings together.

    E_n = mean |I_n − I_(n−1)| − q₀.₁                                                                      (1)
    c(T) = Σ_t E_a(t) E_b(t − T) / √(Σ E_a² Σ E_b²)                                                        (2)

I are reduced images (`checking.survey`), q₀.₁ is the tenth percentile of all images: where nobody moves, noise is left; E is not less than
0. The energies are brought to one grid of times, and c is largest where one view began T after the other: as they are, which finds motion
that begins or ends, and without their means, which finds the rhythm of motion that never stops. From another side the same motion has
another rhythm, so these are candidates, which the rays of moving points must confirm.
"""

from collections.abc import Sequence

import numpy as np

from ..checking.survey import motion_energy, reduced
from ..foundation.progress import Monitor
from ..images.interlace import RowGrid
from ..images.sequence import ImageSequence

QUIET = 0.1  # quantile (1)
GRID_S = 1 / 60  # of the energies
APART_S = 0.5  # of two candidates
CANDIDATES = 4
LEAST_CORRELATION = 0.2  # of a candidate


def energy_of(sequence: ImageSequence, rows: RowGrid, monitor: Monitor) -> np.ndarray:
    """E (n − 1,) of (1) between the n images of a view.

    Raises:
        InputError: an image cannot be read.
        Cancelled: the monitor was cancelled.
    """
    energy, before = np.zeros(max(sequence.count - 1, 0)), None
    for n in range(sequence.count):
        monitor.step("reading the motion", n, sequence.count)
        small = reduced(rows.rows(sequence.read(n)))
        if before is not None:
            energy[n - 1] = motion_energy(before, small)
        before = small
    return np.maximum(energy - np.quantile(energy, QUIET), 0.0) if len(energy) else energy


def offsets_by_motion(a: np.ndarray, b: np.ndarray, a_s: np.ndarray, b_s: np.ndarray) -> list[float]:
    """By how many seconds view b may have begun after a, the most probable first: energies (n,), (m,) of (1) at times (n,), (m,) on the
    clocks of the views."""
    if min(len(a), len(b)) < 2:
        return []
    grids = [np.arange(t[0], t[-1], GRID_S) for t in (a_s, b_s)]
    energies = [np.interp(grid, t, e) for grid, t, e in zip(grids, (a_s, b_s), (a, b))]
    found = [*_peaks(*energies), *_peaks(*(e - e.mean() for e in energies))]
    chosen = list[float]()
    for correlation, steps in sorted(found, reverse=True):
        offset_s = float(grids[0][0] - grids[1][0] + steps * GRID_S)
        if correlation > LEAST_CORRELATION and all(abs(offset_s - other) > APART_S for other in chosen):
            chosen.append(offset_s)
    return chosen[:CANDIDATES]


def _peaks(a: np.ndarray, b: np.ndarray) -> Sequence[tuple[float, int]]:
    """The largest c of (2) and the steps by which b is later than a."""
    from scipy.signal import correlate

    length = float(np.sqrt((a @ a) * (b @ b)))
    if not length:
        return []
    c, found = correlate(a, b, method="fft") / length, list[tuple[float, int]]()
    around = round(APART_S / GRID_S)
    for _ in range(CANDIDATES):
        best = int(np.argmax(c))
        found.append((float(c[best]), best - (len(b) - 1)))
        c[max(0, best - around) : best + around + 1] = -1.0
    return found
