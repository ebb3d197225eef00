"""The head's registration: its derivatives equal differences."""

import numpy as np

from tricap.core.body.skin.head_place import PRIOR
from tricap.core.body.skin.similarity import changed, derivatives, moved


def test_derivatives_equal_differences() -> None:
    rng, step = np.random.default_rng(0), 1e-6
    x, p = rng.normal(0, 0.1, (50, 3)), rng.normal(0, 3 * PRIOR.sigma)
    middle = x.mean(axis=0)
    steps = step * np.eye(len(p))
    differences = [(moved(x, middle, changed(p, h)) - moved(x, middle, changed(p, -h))) / (2 * step) for h in steps]
    np.testing.assert_allclose(derivatives(x, middle, p), np.stack(differences, axis=2), atol=1e-8)
