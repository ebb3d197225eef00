"""Drawing in a Clip Editor: from Tricap's pixels to the region and back, and lines, points, areas and text.

Coordinates are Tricap's full-frame pixels. Batches are made once, in image pixels, and drawn in `image_space`: zooming and
panning cost nothing.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ..scene import axes

Colour = tuple[float, float, float, float]
TEXT_PX = 13
BACKING: Colour = (0.05, 0.05, 0.05, 0.65)  # under text and graphs


class Canvas:
    """The mapping between the image of a clip and a region of a Clip Editor."""

    def __init__(self, region: bpy.types.Region, size_px: tuple[int, int]) -> None:
        self.region, self.size_px = region, (int(size_px[0]), int(size_px[1]))
        span = 4096.0  # region_to_view counts in floats, view_to_region in whole pixels
        low, high = (np.array(region.view2d.region_to_view(v, v)) for v in (0.0, span))
        self._scale = span / np.where(high == low, 1.0, high - low)  # region pixels per unit of the view
        self._origin = -low * self._scale

    def to_region(self, xy_px: np.ndarray) -> np.ndarray:
        """Pixels of the region (…, 2) of image pixels (…, 2)."""
        return axes.uv_from_pixel(xy_px, self.size_px) * self._scale + self._origin

    def to_image(self, xy_region: np.ndarray | Sequence[float]) -> np.ndarray:
        """Image pixels (…, 2) of pixels of the region (…, 2)."""
        return axes.pixel_from_uv((np.asarray(xy_region, dtype=np.float64) - self._origin) / self._scale, self.size_px)

    @property
    def zoom(self) -> float:
        """Region pixels per image pixel."""
        return float(self._scale[0] / self.size_px[0])

    @contextmanager
    def image_space(self) -> Iterator[None]:
        """Draw in image pixels inside this context."""
        origin, unit = self.to_region(np.zeros(2)), self.to_region(np.ones(2)) - self.to_region(np.zeros(2))
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(Matrix.Translation((*origin, 0.0)) @ Matrix.Diagonal((*unit, 1.0, 1.0)))
            yield


def clip_of(area: bpy.types.Area) -> bpy.types.MovieClip | None:
    """The clip that an area shows, if it is a Clip Editor in clip view."""
    space = area.spaces.active if area.type == "CLIP_EDITOR" else None
    return space.clip if space is not None and space.view == "CLIP" else None


def window_region(area: bpy.types.Area) -> bpy.types.Region:
    """The main region of an area."""
    return next(region for region in area.regions if region.type == "WINDOW")


def clip_areas(window: bpy.types.Window) -> list[bpy.types.Area]:
    """The Clip Editors of a window that show footage."""
    return [area for area in window.screen.areas if clip_of(area) is not None]


def area_under(window: bpy.types.Window, x: int, y: int) -> bpy.types.Area | None:
    """The Clip Editor whose image is at this place in the window; None over its sidebar, header or tools."""
    for area in window.screen.areas:
        if area.x <= x < area.x + area.width and area.y <= y < area.y + area.height:
            inside = {r.type for r in area.regions if r.width > 1 and r.x <= x < r.x + r.width and r.y <= y < r.y + r.height}
            return area if clip_of(area) is not None and inside == {"WINDOW"} else None
    return None


def redraw_clips(context: bpy.types.Context, *, pictures_only: bool = False) -> None:
    """Redraw all Clip Editors, with their sidebars unless `pictures_only`."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "CLIP_EDITOR":
                (window_region(area) if pictures_only else area).tag_redraw()


def go_to_frame(scene: bpy.types.Scene, frame: int) -> None:
    """Show a frame, in the Clip Editors too: `frame_set` leaves these at the frame before, under overlays and clicks of the new one."""
    scene.frame_current = frame


def line_batch(segments: np.ndarray, colours: np.ndarray | None = None) -> gpu.types.GPUBatch:
    """A batch of separate lines: segments (N, 2, 2) and, for `draw_lines` without a colour, colours (N, 4)."""
    position = np.zeros((2 * len(segments), 3), dtype=np.float32)
    position[:, :2] = np.asarray(segments, dtype=np.float32).reshape(-1, 2)
    if colours is None:
        return batch_for_shader(gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR"), "LINES", {"pos": position})
    each = np.repeat(np.asarray(colours, dtype=np.float32), 2, axis=0)
    return batch_for_shader(gpu.shader.from_builtin("POLYLINE_FLAT_COLOR"), "LINES", {"pos": position, "color": each})


def chain(points: np.ndarray, *, closed: bool = False) -> np.ndarray:
    """The segments (M, 2, 2) of a polyline (N, 2)."""
    if closed and len(points):
        points = np.concatenate([points, points[:1]])
    return np.stack([points[:-1], points[1:]], axis=1) if len(points) > 1 else np.zeros((0, 2, 2))


def draw_lines(batch: gpu.types.GPUBatch, width: float, colour: Colour | None = None) -> None:
    """Draw a batch from `line_batch`, in one colour if it has no colours of its own."""
    shader = gpu.shader.from_builtin("POLYLINE_FLAT_COLOR" if colour is None else "POLYLINE_UNIFORM_COLOR")
    shader.bind()
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", width)
    if colour is not None:
        shader.uniform_float("color", colour)
    batch.draw(shader)


def colour_bar(colours: np.ndarray, labels: Sequence[str], title: str, x: float, y: float, width: float) -> None:
    """A legend on a dark ground: colours (N, 3) 0 to 1 from left to right, labels below at equal distances, the title above. (x, y) is its
    lower left corner."""
    scale = bpy.context.preferences.system.ui_scale
    bar_y, height = y + 18 * scale, 8 * scale
    pad = 8 * scale
    fill(rectangle(x - pad, y - 2 * scale, width + 2 * pad, 48 * scale), BACKING)
    for i, colour in enumerate(colours):
        fill(rectangle(x + i * width / len(colours), bar_y, width / len(colours) + 0.5, height), (*map(float, colour), 1.0))
    for i, label in enumerate(labels):
        room = width - text_width(label, size=11)
        text(label, x + room * i / max(len(labels) - 1, 1), y + 4 * scale, size=11)
    text(title, x, bar_y + height + 6 * scale, size=11)


def draw_lines_in_space(segments_m: np.ndarray, colours: np.ndarray, width: float) -> None:
    """Draw segments (M, 2, 3) of the world with colours (M, 4), in the 3-D view, in front of everything."""
    shader = gpu.shader.from_builtin("POLYLINE_FLAT_COLOR")
    place = {"pos": segments_m.reshape(-1, 3).astype(np.float32), "color": np.repeat(colours, 2, axis=0).astype(np.float32)}
    gpu.state.depth_test_set("NONE")
    draw_lines(batch_for_shader(shader, "LINES", place), width)


def point_batch(points: np.ndarray, colours: np.ndarray) -> gpu.types.GPUBatch:
    """A batch of points (N, 2) with colours (N, 4)."""
    position = np.zeros((len(points), 3), dtype=np.float32)
    position[:, :2] = points
    shader = gpu.shader.from_builtin("POINT_FLAT_COLOR")
    return batch_for_shader(shader, "POINTS", {"pos": position, "color": np.asarray(colours, dtype=np.float32)})


def draw_points(batch: gpu.types.GPUBatch, size: float) -> None:
    """Draw a batch from `point_batch`."""
    gpu.state.point_size_set(size)
    batch.draw(gpu.shader.from_builtin("POINT_FLAT_COLOR"))


def fill(triangles: np.ndarray, colour: Colour) -> None:
    """Draw triangles (N, 3, 2) in one colour."""
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    position = np.zeros((3 * len(triangles), 3), dtype=np.float32)
    position[:, :2] = np.asarray(triangles, dtype=np.float32).reshape(-1, 2)
    shader.uniform_float("color", colour)
    batch_for_shader(shader, "TRIS", {"pos": position}).draw(shader)


def fill_each(triangles: np.ndarray, colours: np.ndarray) -> None:
    """Draw triangles (N, 3, 2), each in its colour (N, 4), at once."""
    position = np.zeros((3 * len(triangles), 3), dtype=np.float32)
    position[:, :2] = triangles.reshape(-1, 2)
    each = np.repeat(colours, 3, axis=0).astype(np.float32)
    shader = gpu.shader.from_builtin("FLAT_COLOR")
    batch_for_shader(shader, "TRIS", {"pos": position, "color": each}).draw(shader)


def rectangle(x: float, y: float, width: float, height: float) -> np.ndarray:
    """Two triangles (2, 3, 2)."""
    a, b, c, d = (x, y), (x + width, y), (x + width, y + height), (x, y + height)
    return np.array([[a, b, c], [a, c, d]])


def ring(centre: np.ndarray, radius: float, corners: int = 24) -> np.ndarray:
    """Segments (M, 2, 2) of a circle."""
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return chain(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1), closed=True)


def cross(centre: np.ndarray, radius: float, gap: float = 0.0) -> np.ndarray:
    """Segments (4, 2, 2) of a cross with a gap at its centre."""
    arms = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
    return np.stack([centre + gap * arms, centre + radius * arms], axis=1)


def text(words: str, x: float, y: float, colour: Colour = (1.0, 1.0, 1.0, 1.0), *, size: float = TEXT_PX) -> None:
    """Draw text with a shadow, at region pixels."""
    scale = bpy.context.preferences.system.ui_scale
    blf.size(0, size * scale)
    blf.color(0, *colour)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 3, 0.0, 0.0, 0.0, 0.9)
    blf.position(0, x, y, 0.0)
    blf.draw(0, words)
    blf.disable(0, blf.SHADOW)


def text_height(*, size: float = TEXT_PX) -> float:
    """Height of a line of text in region pixels."""
    blf.size(0, size * bpy.context.preferences.system.ui_scale)
    return float(blf.dimensions(0, "Ag")[1])


def text_width(words: str, *, size: float = TEXT_PX) -> float:
    """Width of text in region pixels."""
    blf.size(0, size * bpy.context.preferences.system.ui_scale)
    return float(blf.dimensions(0, words)[0])
