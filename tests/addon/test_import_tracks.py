"""2-D tracks in a real Blender: points lie on their pixels, curves hang on them, gaps are hidden, undo, and what is refused."""

from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

TRACKS = """frame,point,x,y,sigma,correlation,status
3,nose,19.5,9.5,0.1,1,measured
3,chin,39.5,29.5,0.1,1,measured
4,nose,21.5,9.5,0.1,1,measured
4,chin,,,,,not_found
5,nose,23.5,9.5,0.1,1,measured
5,chin,43.5,29.5,0.1,1,measured
"""
POINTS = "point,x,y,joined_to\nnose,19.5,9.5,\nchin,39.5,29.5,nose\n"


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """The tables, and eight images of 80×40 that begin with number 11."""
    (tmp_path / "tracks.csv").write_text(TRACKS)
    (tmp_path / "points.csv").write_text(POINTS)
    (tmp_path / "face").mkdir()
    for i in range(8):
        (tmp_path / "face" / f"img_{11 + i:03d}.png").write_bytes(cv2.imencode(".png", np.full((40, 80), 30 * i, np.uint8))[1].tobytes())
    return dict(filepath=str(tmp_path / "tracks.csv"), points=str(tmp_path / "points.csv"), footage=str(tmp_path / "face"))


def at(bpy: ModuleType, frame: int) -> tuple[Any, dict[str, Any]]:
    """The dependency graph of a frame, and its objects by name."""
    bpy.context.scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    return graph, {o.name: o.evaluated_get(graph) for o in bpy.data.objects}


def test_points_and_curves_lie_on_their_pixels(blender: ModuleType, empty: ModuleType, files: dict[str, str]) -> None:
    """The picture is 1 m wide and stands in the xz plane; moved, it takes all along."""
    assert empty.ops.tricap.import_tracks2d(**files) == {"FINISHED"}
    picture = empty.data.objects["Footage"]
    assert picture.empty_display_type == "IMAGE" and picture.data.source == "SEQUENCE"
    user = picture.image_user
    assert (user.frame_start, user.frame_duration, user.frame_offset) == (0, 8, 10)  # file 11 is image 0
    for shift in (0.0, 2.0):
        picture.location.x = shift
        for frame, nose, chin in ((3, (-0.25, 0.125), (0.0, -0.125)), (5, (-0.2, 0.125), (0.05, -0.125))):
            graph, found = at(empty, frame)
            for name, (x, z) in (("nose", nose), ("chin", chin)):
                assert np.allclose(found[name].matrix_world.translation, (x + shift, -0.002, z), atol=1e-6)
            line = found["chin – nose"]
            mesh = line.to_mesh(depsgraph=graph)
            ends = np.array([line.matrix_world @ v.co for v in mesh.vertices])
            line.to_mesh_clear()
            for x, z in (nose, chin):
                assert np.linalg.norm(ends - (x + shift, -0.002, z), axis=1).min() < 0.002
    assert empty.context.scene.frame_end >= 5


def test_gaps_are_hidden(blender: ModuleType, empty: ModuleType, files: dict[str, str]) -> None:
    assert empty.ops.tricap.import_tracks2d(**files | {"footage": ""}) == {"FINISHED"}
    for frame, hidden in ((3, False), (4, True), (5, False)):
        empty.context.scene.frame_set(frame)
        for name, gone in (("nose", False), ("chin", hidden), ("chin – nose", hidden)):
            shown = empty.data.objects[name]
            assert (shown.hide_viewport, shown.hide_render) == (gone, gone), (frame, name)
    assert empty.data.objects["Footage"].data is None


def test_undo_and_what_is_refused(blender: ModuleType, empty: ModuleType, files: dict[str, str], tmp_path: Path) -> None:
    def objects() -> int:
        return len(empty.context.scene.objects)

    empty.ops.ed.undo_push(message="before")
    assert empty.ops.tricap.import_tracks2d(**files) == {"FINISHED"} and objects() == 4
    empty.ops.ed.undo_push(message="after")
    empty.ops.ed.undo()
    assert objects() == 0 and not empty.data.collections
    (tmp_path / "other.csv").write_text("point,x,y,joined_to\nnose,1,1,\near,2,2,nose\n")
    (tmp_path / "none.csv").write_text("frame,point,x,y\n1,a,b,c\n")
    for changed, said in (
        ({"points": str(tmp_path / "other.csv")}, "“ear”"),
        ({"filepath": str(tmp_path / "none.csv")}, "not a table of 2-D"),
        ({"filepath": str(tmp_path / "gone.csv")}, "Cannot read"),
        ({"footage": str(tmp_path / "gone.mp4")}, "missing"),
    ):
        with pytest.raises(RuntimeError, match=said):
            empty.ops.tricap.import_tracks2d(**files | changed)
        assert objects() == 0
