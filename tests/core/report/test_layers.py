"""The picture of the body's layers, and what every picture has: a scale of a round length, and axes."""

import cv2
import numpy as np
import pytest

from tricap.core.body.complete import complete_shape
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skin.contour_skin import body_skin
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.raster import rasterize
from tricap.core.report.drawing import add_axes, add_scale, length_words
from tricap.core.report.layers import GROUND, KIND_COLOURS, PANEL_PX, kinds_shown, layers_picture
from tricap.core.report.person import Coloured, Mesh


@pytest.fixture(scope="module")
def panels() -> list[np.ndarray]:
    shape = complete_shape(default_shape(read_model("arm.R")))
    assert kinds_shown(shape) == "white: bone, red: muscle" and "flesh" in kinds_shown(default_shape(read_model("arm.R")))
    skin = body_skin(shape, np.zeros(len(shape.skeleton.dofs)))
    picture = layers_picture(shape, skin, Mesh(vertices_m=skin.vertices_m, triangles=skin.triangles, weights=skin.weights))
    assert picture.shape == (PANEL_PX[1], 4 * PANEL_PX[0], 3)
    return np.split(picture, 4, axis=1)


def covered(panel: np.ndarray) -> np.ndarray:
    """Where a panel shows the body: not its title, scale and axes."""
    there = (panel != GROUND).any(axis=2)
    there[:30], there[-60:] = False, False
    return there


def test_each_layer_is_within_the_next(panels: list[np.ndarray]) -> None:
    """The skeleton lies in the balls and the skin, and the polygons are the shaded skin's; all in one place."""
    skeleton, balls, polygons, skin = (covered(p) for p in panels)
    assert 500 < skeleton.sum() < balls.sum() < skin.sum()
    about = cv2.dilate(skin.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # lines lie on the outline, and are blurred
    assert (balls & skin).sum() > 0.95 * balls.sum() and (polygons & ~about).sum() < 0.01 * polygons.sum()
    red = np.array(KIND_COLOURS["muscle"])
    muscle = np.abs(panels[1][covered(panels[1])].astype(float) / red - (panels[1][covered(panels[1])][:, 2:] / red[2])).max(axis=1) < 0.1
    assert 0.02 < muscle.mean() < 0.6, "muscles in their colour, between the bones in theirs"


def test_the_texture_lies_upright_on_the_skin() -> None:
    """A square before a camera, whose picture has red above, green below, and blue at the right."""
    picture = np.zeros((40, 40, 3), np.uint8)
    picture[:20], picture[20:], picture[:, 30:] = (0, 0, 255), (0, 255, 0), (255, 0, 0)
    corners = np.array([[-1.0, 1.0, 4.0], [1.0, 1.0, 4.0], [1.0, -1.0, 4.0], [-1.0, -1.0, 4.0]])  # y downwards
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])[:, ::-1]
    skin = Coloured(vertices_m=corners, triangles=triangles, uv=uv[triangles], bgr=picture)
    camera = Camera(name="C", size_px=(80, 80), matrix=np.array([[120.0, 0, 39.5], [0, 120.0, 39.5], [0, 0, 1]]), distortions=np.zeros(5),
                    R_cam_world=np.eye(3), t_cam_world_m=np.zeros(3))  # fmt: skip
    raster = rasterize(camera, skin.vertices_m, skin.triangles, back_faces=True)
    shown = np.zeros((*raster.shape, 3), np.uint8)
    shown.reshape(-1, 3)[raster.sample] = skin.colours(raster)
    assert shown[20, 20].tolist() == [0, 0, 255] and shown[60, 20].tolist() == [0, 255, 0] and shown[40, 66].tolist() == [255, 0, 0]


def test_with_a_texture_there_is_one_more_layer() -> None:
    shape = default_shape(read_model("arm.R"))
    skin = body_skin(shape, np.zeros(len(shape.skeleton.dofs)))
    mesh = Mesh(vertices_m=skin.vertices_m, triangles=skin.triangles, weights=skin.weights)
    blue = np.full((8, 8, 3), (200, 0, 0), np.uint8)
    coloured = Coloured(vertices_m=skin.vertices_m, triangles=skin.triangles, uv=np.full((len(skin.triangles), 3, 2), 0.5), bgr=blue)
    *_, shaded, textured = np.split(layers_picture(shape, skin, mesh, coloured), 5, axis=1)
    there = covered(textured)
    assert (there & covered(shaded)).sum() > 0.97 * there.sum() and textured[there].max(axis=0).tolist()[0] > 150
    assert np.median(textured[there][:, 1:]) == 0


@pytest.mark.parametrize(
    ("px_per_m", "bar_px", "words"), [(100.0, 50, "50 cm"), (1000.0, 50, "5 cm"), (30.0, 60, "2 m"), (12_000.0, 60, "5 mm")]
)
def test_the_scale_has_a_round_length(px_per_m: float, bar_px: int, words: str) -> None:
    picture = np.zeros((120, 200, 3), np.uint8)
    add_scale(picture, px_per_m)
    white = np.flatnonzero((picture[106] == 255).all(axis=1))
    assert abs(np.ptp(white) - bar_px) <= 3
    assert words == length_words(bar_px / px_per_m)


def test_nothing_without_a_scale_and_axes_point_where_they_should() -> None:
    picture = np.zeros((120, 200, 3), np.uint8)
    add_scale(picture, float("nan"))
    add_scale(picture, 0.0)
    assert not picture.any()
    for left, up in ((False, False), (True, False), (False, True)):
        picture[:] = 0
        add_axes(picture, ("x", "y"), left=left, up=up)
        y, x = np.nonzero(picture.any(axis=2))
        corner = np.array([200 - 48, 120 - (18 if up else 44)])
        assert (x.min() < corner[0] - 20) == left and (y.min() < corner[1] - 20) == up
