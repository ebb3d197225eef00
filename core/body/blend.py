"""Where two parts of a body meet, one surface: balls that both count are counted once, and what is each one's own is blended.

    C = Σ min(α, β) f ,   A = Σ α f − C ,   B = Σ β f − C                                                    (1)
    G = C + (A^n + B^n)^(1/n) ,   n = 4                                                                     (2)

f are the fields of the balls at a place, α and β how much the two parts count each. The field of a part's bone holds the balls of the bones
that it meets, as in the fit, so next to a joint both fields are the same sum: a blend of the whole fields (Ricci 1973, Comput. J. 16) made
chest and pelvis 8 to 13 mm thicker than they were fitted. (2) is Ricci's for what only one of them has: the fitted surface where the
other is far, 2^(1/n) of the larger where both are equal.
"""

import numpy as np

BLEND_POWER = 4.0  # n of (2): a fillet of 4 mm on a radius of 60 mm
NOTHING = 1e-300


def blended(terms: np.ndarray, first: np.ndarray, second: np.ndarray, fade: np.ndarray | float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """G (N,) of (2) from fields of balls (N, m) and how much each of two parts counts them (N, m), with B times `fade` (N,).

    Also the balls' factors (N, m) in G and in its derivatives: G = Σ factor f, dG = Σ factor df.
    """
    both = np.minimum(first, second)
    return joined(terms, both, first - both, np.reshape(fade, (-1, 1)) * (second - both))


def joined(terms: np.ndarray, both: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2) from the factors (N, m) of C, A and B."""
    A, B = np.maximum(_sum(terms, a), NOTHING), np.maximum(_sum(terms, b), NOTHING)
    larger = np.maximum(A, B)
    S = larger * ((A / larger) ** BLEND_POWER + (B / larger) ** BLEND_POWER) ** (1 / BLEND_POWER)
    of_a, of_b = (A / S) ** (BLEND_POWER - 1), (B / S) ** (BLEND_POWER - 1)
    return _sum(terms, both) + S, both + of_a[:, None] * a + of_b[:, None] * b


def _sum(terms: np.ndarray, factors: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("nm,nm->n", terms, factors))
