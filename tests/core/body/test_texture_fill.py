"""Colours of what no view showed: a painted body of which a quarter was seen."""

from functools import lru_cache

import numpy as np

from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skin.closed_skin import one_skin
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.surface_operators import vertex_normals
from tricap.core.body.skin.texture import _texels
from tricap.core.body.skin.texture_fill import HEADS, PLAIN, Texels, _other_side, filled
from tricap.core.foundation.progress import Monitor

AHEAD = np.array([0.0, -1.0, 0.0])


@lru_cache(maxsize=1)
def texels() -> Texels:
    skin = one_skin(default_shape(read_model("full")), SkinSettings())
    _, corners, shares = _texels(skin, 192)
    return Texels(skin=skin, corners=corners, shares=shares, ahead=AHEAD)


def stripes(xyz_m: np.ndarray) -> np.ndarray:
    """The same on both sides, and on front and back."""
    return np.repeat(120 + 60 * np.sin(60 * np.abs(xyz_m[:, :1]) + 40 * xyz_m[:, 2:]), 3, axis=1)


def test_the_other_side_and_the_back_have_the_colours_of_what_was_seen() -> None:
    t = texels()
    places, ahead = t.at(t.skin.vertices_m), t.at(vertex_normals(t.skin.vertices_m, t.skin.faces)) @ AHEAD
    head = t.at(t.skin.weights[:, t.skin.bone_names.index("head")]) > HEADS
    paint, seen = stripes(places), (places[:, 0] > -0.01) & (ahead > -0.1)
    found = filled(t, np.where(seen[:, None], paint, 0.0), seen, Monitor())
    assert np.array_equal(found[seen], paint[seen])
    error = np.abs(found - paint).max(axis=1)
    for hidden in (~seen & (ahead > 0), (ahead < -0.3) & ~head):
        assert hidden.sum() > 1000 and np.median(error[hidden]) < 8 and np.percentile(error[hidden], 80) < 30
    assert found.min() >= paint[seen].min() and found.max() <= paint[seen].max()


def test_a_head_has_no_second_face() -> None:
    t = texels()
    head = t.at(t.skin.weights[:, t.skin.bone_names.index("head")]) > HEADS
    ahead = t.at(vertex_normals(t.skin.vertices_m, t.skin.faces)) @ AHEAD
    paint = stripes(t.at(t.skin.vertices_m))
    found = filled(t, paint, ahead > 0, Monitor())
    behind = head & (ahead < -0.7)
    assert behind.sum() > 50 and found[behind].std() < 0.5 * paint[behind].std()


def test_the_end_of_what_is_known_is_not_repeated() -> None:
    """Its last colours were drawn out into bands, 3 cm long."""
    t = texels()
    places, normals = t.at(t.skin.vertices_m), t.at(vertex_normals(t.skin.vertices_m, t.skin.faces))
    low = np.quantile(places[:, 2], 0.4)
    known = np.flatnonzero((places[:, 0] > 0) & (places[:, 2] < low))
    within, beyond = (np.flatnonzero((places[:, 0] < -0.05) & (np.abs(places[:, 2] - low - h) < 0.01)) for h in (-0.03, 0.025))
    assert len(within) > 30 and (_other_side(places, normals, 0.012, known, within) >= 0).mean() > 0.9
    assert len(beyond) > 30 and (_other_side(places, normals, 0.012, known, beyond) < 0).mean() > 0.9


def test_a_flank_has_the_colours_of_like_normals_and_no_bands() -> None:
    """From the front, all places of a flank are at the same place."""
    t = texels()
    ahead = t.at(vertex_normals(t.skin.vertices_m, t.skin.faces)) @ AHEAD
    head = t.at(t.skin.weights[:, t.skin.bone_names.index("head")]) > HEADS
    paint = np.repeat(120 + 100 * np.abs(ahead)[:, None], 3, axis=1)
    found = filled(t, paint, ahead > 0.0, Monitor())[:, 0]
    flank = ~head & (ahead < -0.3) & (ahead > -0.8)
    assert np.median(np.abs(found - paint[:, 0])[flank]) < 8


def test_where_the_surroundings_differ_no_edge_is_left() -> None:
    """The left side is 40 brighter up to where it was seen."""
    t = texels()
    places = t.at(t.skin.vertices_m)
    seen = (places[:, 0] > 0) | (places[:, 2] < 0.3)
    brighter = 40.0 * (places[:, 0] < 0)
    found = filled(t, np.repeat((100.0 + brighter)[:, None], 3, axis=1), seen, Monitor())[:, 0]
    border = (places[:, 0] < -0.1) & (np.abs(places[:, 2] - 0.31) < 0.01)
    far = (places[:, 0] < -0.1) & (places[:, 2] > places[:, 2].max() - 0.4)
    assert border.any() and far.any() and np.median(found[border]) > 120 and np.abs(found[far] - 100).max() < 10


def test_nothing_seen_is_plain() -> None:
    t = texels()
    nothing = np.zeros(len(t.corners), dtype=bool)
    assert (filled(t, np.zeros((len(nothing), 3)), nothing, Monitor()) == PLAIN).all()
