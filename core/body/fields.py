"""The field library: potentials f(d) of metaballs over the squared ellipsoidal distance d = (r/l)² (D'Apuzzo et al. 1999, §3.4.3).

    exponential  e^(−2d)                                          D'Apuzzo et al. 1999, Eq. 8: the only one that is fitted
    Blinn        e^(−a d), a = 4 ln 2                             Blinn 1982, ACM ToG 1(3); half of its weight at half of l
    Wyvill       1 − (22/9) d + (17/9) d² − (4/9) d³,  d < 1      Wyvill, McPheeters & Wyvill 1986, The Visual Computer 2
    quadric      1 − 3 d,  r < l/3;   (3/2)(1 − √d)²,  r < l      Nishimura et al. 1985, “metaballs”
    Blender      (1 − d)³,  d < 1                                 Blender's mball_tessellate.cc
    Shen         1 − d,  d < 1                                    Shen & Thalmann 1995; its slope does not end in 0

w_t = T = ½ is the threshold of the surface, r_t the visible radius of an isolated ball of weight w, f(r_t²) = T/w, and r_a the radius of
influence, beyond which f = 0: l. The first two have no finite radius of influence; for them r_a = l is nominal.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..foundation.errors import InputError
from ..foundation.settings import nearest_name

THRESHOLD = 0.5
VISIBLE = float(np.sqrt(0.5 * np.log(1 / THRESHOLD)))  # r_t / l of the exponential
BLINN = 4 * float(np.log(2))
WYVILL = (22 / 9, 17 / 9, 4 / 9)
LITTLE = 0.0015  # of T: a field below it is invisible

Curve = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True, slots=True)
class Potential:
    """One potential: f and df/dd of d in (0, 1), or of all d where it is `endless`. f(0) = 1. `stretch`: r_a in units of l."""

    name: str
    of: Curve
    slope_of: Curve
    endless: bool = False
    stretch: float = 1.0

    def value(self, d: np.ndarray) -> np.ndarray:
        """f at squared ellipsoidal distances d, of any shape."""
        u = np.asarray(d) / self.stretch**2
        return self.of(u) if self.endless else np.where(u < 1, self.of(np.minimum(u, 1.0)), 0.0)

    def slope(self, d: np.ndarray) -> np.ndarray:
        """df/dd."""
        u = np.asarray(d) / self.stretch**2
        slope = self.slope_of(u) if self.endless else np.where(u < 1, self.slope_of(np.minimum(u, 1.0)), 0.0)
        return slope / self.stretch**2

    @property
    def influence(self) -> float:
        """r_a in units of l; of the endless potentials nominally l."""
        return self.stretch

    @property
    def reach(self) -> float:
        """The radius, in units of l, beyond which the field is invisible."""
        return self.radius_of(LITTLE * THRESHOLD) if self.endless else self.stretch

    def threshold_radius(self, weight: float = 1.0) -> float:
        """r_t in units of l of an isolated ball of this weight; 0 if it is too weak to be visible."""
        return self.radius_of(THRESHOLD / weight) if weight > THRESHOLD else 0.0

    def radius_of(self, value: float) -> float:
        """The radius, in units of l, at which f has a value between 0 and 1, by bisection: every potential decreases monotonically."""
        low, high = 0.0, 4.0 * self.stretch
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if float(self.value(np.array(middle**2))) > value else (low, middle)
        return (low + high) / 2

    def of_visible_size(self) -> "Potential":
        """The same potential, stretched so that an isolated ball has the visible radius of one with the exponential of the same l."""
        return replace(self, stretch=self.stretch * VISIBLE / self.threshold_radius())


def _wyvill(d: np.ndarray) -> np.ndarray:
    a, b, c = WYVILL
    return 1 - d * (a - d * (b - d * c))


def _wyvill_slope(d: np.ndarray) -> np.ndarray:
    a, b, c = WYVILL
    return -a + d * (2 * b - 3 * c * d)


def _quadric(d: np.ndarray) -> np.ndarray:
    return np.where(d < 1 / 9, 1 - 3 * d, 1.5 * (1 - np.sqrt(d)) ** 2)


def _quadric_slope(d: np.ndarray) -> np.ndarray:
    return np.where(d < 1 / 9, -3.0, -1.5 * (1 / np.sqrt(np.maximum(d, 1 / 9)) - 1))


EXPONENTIAL = Potential(name="exponential", of=lambda d: np.exp(-2 * d), slope_of=lambda d: -2 * np.exp(-2 * d), endless=True)
POTENTIALS = {
    p.name: p
    for p in (
        EXPONENTIAL,
        Potential(name="Blinn", of=lambda d: np.exp(-BLINN * d), slope_of=lambda d: -BLINN * np.exp(-BLINN * d), endless=True),
        Potential(name="Wyvill", of=_wyvill, slope_of=_wyvill_slope),
        Potential(name="quadric", of=_quadric, slope_of=_quadric_slope),
        Potential(name="Blender", of=lambda d: (1 - d) ** 3, slope_of=lambda d: -3 * (1 - d) ** 2),
        Potential(name="Shen", of=lambda d: 1 - d, slope_of=lambda d: np.full_like(d, -1.0)),
    )
}


def potential_named(name: str) -> Potential:
    """The potential of that name, with the visible size of the exponential (`of_visible_size`), for the surface of a fitted body.

    Raises:
        InputError: there is none of that name.
    """
    if name not in POTENTIALS:
        raise InputError(f"There is no field “{name}”.{nearest_name(name, list(POTENTIALS))}")
    return POTENTIALS[name] if name == EXPONENTIAL.name else POTENTIALS[name].of_visible_size()
