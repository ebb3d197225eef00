"""What a user may want otherwise: exact skin, T-pose, fewer keys, colours, arrows, pictures."""

import os
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from tricap.__main__ import main
from tricap.core.body.fields import potential_named
from tricap.core.body.metaballs import field
from tricap.core.body.model_file import read_model
from tricap.core.body.shape import default_shape
from tricap.core.body.skeleton import bone_frames
from tricap.core.body.skin.closed_skin import OneSkin
from tricap.core.body.skin.contour_skin import SkinSettings, body_skin
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.person_skin import REST, rest_skin, write_skin
from tricap.core.body.skin.texture import TEXTURE
from tricap.core.foundation import store
from tricap.core.foundation.errors import InputError
from tricap.core.foundation.progress import Cancelled, Monitor

from .conftest import FRAMES, SmallRun
from .test_scene_body import animated, curves, world_vertices


def test_the_exact_skin_is_the_skin_of_every_frame(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.scene.build import SceneOptions, build_scene

    build_scene(small_run.out, tmp_path / "body.blend", options=SceneOptions(exact_skin=True, rest_pose="T"))
    for name in ("body.blend", "body.pc2"):  # both may be moved together
        (tmp_path / "elsewhere é").mkdir(exist_ok=True)
        (tmp_path / name).rename(tmp_path / "elsewhere é" / name)
    empty.ops.wm.open_mainfile(filepath=str(tmp_path / "elsewhere é" / "body.blend"))
    for frame, motion in zip(FRAMES, small_run.motion):
        empty.context.scene.frame_set(frame)
        exact = body_skin(shape_for_skin(small_run.shape, SkinSettings()), motion).vertices_m  # the table keeps nine digits
        assert np.abs(world_vertices(empty, empty.data.objects["Exact skin"]) - exact).max() < 1e-5


def test_exact_skins_replace_no_file_of_another_scene(small_run: SmallRun, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "b.pc2").write_text("mine")
    assert main(["scene", str(small_run.out), "--blend", str(tmp_path / "b.blend"), "--exact-skin"]) == 2
    assert "would overwrite" in capfd.readouterr().err and (tmp_path / "b.pc2").read_text() == "mine"
    shutil.copytree(small_run.out, tmp_path / "copied")
    (tmp_path / "b.blend").write_text("another file of that name")
    assert main(["scene", str(tmp_path / "copied"), "--blend", str(tmp_path / "b.blend"), "--exact-skin"]) == 2
    assert "not of an earlier call" in capfd.readouterr().err and (tmp_path / "b.pc2").read_text() == "mine"


def test_exact_skins_that_cannot_be(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.scene.build import SceneOptions, build_scene

    wanted = SceneOptions(exact_skin=True)
    with pytest.raises(InputError, match="give the Blender file a name"):
        build_scene(small_run.out, options=wanted)
    said = {"format": "tricap-run", "version": 1, "take": str(small_run.take)}
    store.write_json(small_run.out / "run.json", {**said, "settings": {"skin": {"rays": 25}}})
    report = build_scene(small_run.out, tmp_path / "a.blend", options=wanted)
    assert any("even number of rays" in warning for warning in report.warnings) and not (tmp_path / "a.pc2").exists()
    store.write_json(small_run.out / "run.json", {**said, "settings": {"skin": {"rays": "many"}}})
    with pytest.raises(InputError, match="rays"):
        build_scene(small_run.out, tmp_path / "a.blend", options=wanted)
    store.write_json(small_run.out / "run.json", said)
    (small_run.out / "motion.csv").unlink()
    assert any("the run has no body" in warning for warning in build_scene(small_run.out, tmp_path / "a.blend", options=wanted).warnings)


def test_the_implicit_surface_is_that_of_the_field(empty: ModuleType, small_run: SmallRun) -> None:
    import bmesh

    from tricap.addon.scene.build import SceneOptions, build_scene

    build_scene(small_run.out, options=SceneOptions(implicit=True))
    middle = len(FRAMES) // 2
    checked = empty.data.objects[f"Implicit surface {FRAMES[middle]:04d}"]
    points = world_vertices(empty, checked)
    R, head = bone_frames(small_run.shape.skeleton, small_run.shape.lengths_m, small_run.motion[middle])
    assert np.abs(field(small_run.shape.metaballs, small_run.shape.lengths_m, R, head, points) - 0.5).max() < 0.012
    mesh = bmesh.new()
    mesh.from_mesh(checked.data)
    assert all(edge.is_manifold for edge in mesh.edges) and mesh.calc_volume(signed=True) > 0
    mesh.free()
    build_scene(small_run.out, options=SceneOptions(implicit=True, field="Wyvill"))
    other = world_vertices(empty, empty.data.objects[f"Implicit surface {FRAMES[middle]:04d} Wyvill"])
    found = field(small_run.shape.metaballs, small_run.shape.lengths_m, R, head, other, potential=potential_named("Wyvill"))
    assert np.abs(found - 0.5).max() < 0.02 and points.shape != other.shape
    with pytest.raises(InputError, match="no field"):
        build_scene(small_run.out, options=SceneOptions(implicit=True, field="Shan"))


@cache
def skin_at_rest(model: str) -> OneSkin:
    """What `add_skin` makes without a prepared one; a whole body's takes two seconds."""
    return rest_skin(default_shape(read_model(model)), SkinSettings())


def crossing_faces(bpy: ModuleType, thing: object) -> int:
    """How many pairs of faces of the deformed mesh pass through each other."""
    from mathutils.bvhtree import BVHTree

    corners = [list(face.vertices) for face in thing.data.polygons]
    tree = BVHTree.FromPolygons(world_vertices(bpy, thing).tolist(), corners)
    return sum(a < b and not set(corners[a]) & set(corners[b]) for a, b in tree.overlap(tree))


@pytest.mark.slow
@pytest.mark.parametrize(("model", "bones"), [("arm.R", ["forearm.R"]), ("leg.L", ["shin.L"]), ("full", ["forearm.L", "shin.R"])])
def test_elbows_and_knees_bend_without_the_skin_crossing_itself(empty: ModuleType, model: str, bones: list[str]) -> None:
    from tricap.addon.scene import armature, skin

    shape = default_shape(read_model(model))
    body = armature.add_armature(empty.context.scene.collection, shape)
    bent = skin.add_skin(empty.context.scene.collection, body, shape, prepared=skin_at_rest(model))
    for degrees in (0, 80, 140):
        for bone in bones:
            body.pose.bones[bone].rotation_euler[0] = np.radians(degrees)
        empty.context.view_layer.update()
        assert crossing_faces(empty, bent) == 0, degrees
    bent.modifiers["Armature"].use_deform_preserve_volume = False
    empty.context.view_layer.update()
    assert crossing_faces(empty, bent) > 0  # without it the elbow collapses


def test_a_stout_knee_bends_as_far_as_a_slender_one(empty: ModuleType) -> None:
    """A fifth thicker than the model, as people are; shares that ended after seven tenths of the bones gave eleven crossings."""
    from tricap.addon.scene import armature, skin

    slender = default_shape(read_model("leg.L"))
    stout = replace(slender, metaballs=replace(slender.metaballs, radii_m=slender.metaballs.radii_m * [1.2, 1.0, 1.2]))
    body = armature.add_armature(empty.context.scene.collection, stout)
    bent = skin.add_skin(empty.context.scene.collection, body, stout)
    body.pose.bones["shin.L"].rotation_euler[0] = np.radians(140)
    empty.context.view_layer.update()
    assert crossing_faces(empty, bent) == 0


def test_the_texture_is_packed_and_exported(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.retarget.export import export_file
    from tricap.addon.scene.build import build_scene

    shape, colour = shape_for_skin(small_run.shape, SkinSettings()), (200, 60, 20)  # RGB
    made = rest_skin(shape, SkinSettings())
    v = len(made.vertices_m)
    write_skin(small_run.out / "skin" / REST, replace(made, relief_m=np.zeros(v), sigma_m=np.full(v, 0.003)))
    cv2.imwrite(str(small_run.out / "skin" / TEXTURE), np.full((16, 16, 3), colour[::-1], np.uint8))
    for _ in range(2):  # nothing of the first remains
        build_scene(small_run.out)
    images = [image for image in empty.data.images if image.packed_file]
    skin_object = empty.data.objects["Skin"]
    assert len(images) == 1 and skin_object.data.materials[0].node_tree.nodes.active.image is images[0]
    assert np.allclose(np.array(images[0].pixels[:3]) * 255, colour, atol=1)
    assert skin_object.data.attributes["sigma_m"].data[5].value == pytest.approx(0.003)
    export_file(small_run.out, "glb", tmp_path / "a.glb", "plain", Monitor())
    empty.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    empty.ops.import_scene.gltf(filepath=str(tmp_path / "a.glb"))
    assert [tuple(image.size) for image in empty.data.images if image.packed_file] == [(16, 16)]
    (small_run.out / "skin" / TEXTURE).write_bytes(b"no image")
    assert any("no readable image" in w for w in build_scene(small_run.out).warnings)


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_the_colours_of_a_usd_file_replace_others_and_stay_in_its_folder(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    """Blender keeps a picture of that name, which may be another person's, and follows a link of the folder's name."""
    from tricap.addon.retarget.export import export_file

    out, elsewhere = tmp_path / "usd", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine.png").write_text("mine")
    (out / "textures").mkdir(parents=True)
    made = rest_skin(shape_for_skin(small_run.shape, SkinSettings()), SkinSettings())
    v = len(made.vertices_m)
    write_skin(small_run.out / "skin" / REST, replace(made, relief_m=np.zeros(v), sigma_m=np.full(v, 0.003)))
    assert cv2.imwrite(str(small_run.out / "skin" / TEXTURE), np.full((16, 16, 3), 99, np.uint8))
    (out / "textures" / "a.usd_1.png").symlink_to(elsewhere / "mine.png")
    export_file(small_run.out, "usd", out / "a.usd", "plain", Monitor())
    assert (out / "textures" / "a.usd_1.png").read_bytes().startswith(b"\x89PNG") and (elsewhere / "mine.png").read_text() == "mine"
    assert sorted(path.name for path in out.iterdir()) == ["a.usd", "textures"]
    first = (out / "textures" / "a.usd_1.png").read_bytes()
    assert cv2.imwrite(str(small_run.out / "skin" / TEXTURE), np.full((16, 16, 3), 200, np.uint8))
    export_file(small_run.out, "usd", out / "b.usd", "plain", Monitor())
    assert (out / "textures" / "a.usd_1.png").read_bytes() == first != (out / "textures" / "b.usd_1.png").read_bytes()
    export_file(small_run.out, "usd", out / "a.usd", "plain", Monitor())
    assert (out / "textures" / "a.usd_1.png").read_bytes() != first  # of an earlier export into this file
    (out / "a.usd").write_text("a note")
    (out / "textures" / "a.usd_1.png").write_text("mine")
    with pytest.raises(InputError, match="a.usd_1.png would be overwritten, and is not of an earlier export"):
        export_file(small_run.out, "usd", out / "a.usd", "plain", Monitor())
    assert (out / "a.usd").read_text() == "a note" and (out / "textures" / "a.usd_1.png").read_text() == "mine"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "textures").symlink_to(elsewhere)
    with pytest.raises(InputError, match="textures is a link to a place outside"):
        export_file(small_run.out, "usd", tmp_path / "other" / "a.usd", "plain", Monitor())
    assert [path.name for path in elsewhere.iterdir()] == ["mine.png"]


def test_one_skin_is_shown_and_metaballs_are_excluded_behind_it(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene import excluded, metaballs
    from tricap.addon.scene.build import build_scene

    build_scene(small_run.out)
    shown = {o.name for o in empty.data.objects if o.type in ("MESH", "META") and o.name.startswith(("Skin", "Flesh")) and o.visible_get()}
    assert shown == {"Skin"} and not empty.data.objects["Skin"].hide_render and empty.data.objects["Flesh"].hide_render
    excluded.show(empty.context.scene, metaballs.COLLECTION_KEY, True)
    flesh = empty.data.objects["Flesh"].evaluated_get(empty.context.evaluated_depsgraph_get())
    assert len(flesh.to_mesh().vertices) > 100


def test_cloud_and_trajectories_step_back_behind_the_skin(blender: ModuleType, small_run: SmallRun) -> None:
    """They would lie over it. The switch shows them; who asks for arrows of velocities sees them at once."""
    from tricap.addon.scene.build import SceneOptions, build_scene

    scene, measured = blender.context.scene, ("Cloud", "Trajectories")
    build_scene(small_run.out)
    assert not scene.tricap.show_measured and not any(name in blender.context.view_layer.objects for name in measured)
    scene.tricap.show_measured = True
    assert all(blender.data.objects[name].visible_get() and name in blender.context.view_layer.objects for name in measured)
    scene.tricap.show_measured = False
    assert not any(name in blender.context.view_layer.objects for name in measured)
    build_scene(small_run.out, options=SceneOptions(arrows=True))
    assert scene.tricap.show_measured and blender.data.objects["Velocities"].visible_get()


def test_points_and_trails_are_wide_enough_for_the_camera(blender: ModuleType, small_run: SmallRun) -> None:
    """Where a person is far away, points of 1.5 mm are a fraction of a pixel, and nobody sees them."""
    from tricap.addon.scene import cloud, trajectories
    from tricap.addon.scene.build import build_scene

    build_scene(small_run.out)
    camera, elbow = small_run.rig["C"], np.array([small_run.joints_m["elbow.R"][len(FRAMES) // 2]])
    pixel_m = cloud.pixel_size_m(camera, elbow)
    assert pixel_m == pytest.approx(camera.to_camera(elbow)[0, 2] / 390, rel=0.03) and pixel_m > 4e-3
    blender.context.scene.frame_set(FRAMES[-1])
    for name, px in (("Cloud", cloud.POINT_RADIUS_PX), ("Trajectories", trajectories.TRAIL_RADIUS_PX)):
        group = blender.data.objects[name].modifiers[0].node_group
        assert group.interface.items_tree["Radius"].default_value == pytest.approx(px * pixel_m, rel=0.03)
    blender.context.scene.tricap.show_measured = True
    trails, widths = blender.data.objects["Trajectories"], []
    for radius_m in (0.0, 0.01):
        trails.modifiers.clear()
        trails.modifiers.new("Trail", "NODES").node_group = trajectories.trail_group(trails.data.materials[0], radius_m=radius_m)
        widths.append(world_vertices(blender, trails))
    assert np.linalg.norm(widths[1] - widths[0], axis=1) == pytest.approx(0.01, rel=0.2)
    assert cloud.pixel_size_m(camera, np.zeros((0, 3))) == 0.0 and trajectories.trail_radius_m(0.0) == trajectories.TRAIL_RADIUS_M


def test_lights_and_floor(empty: ModuleType, small_run: SmallRun) -> None:
    from tricap.addon.scene.build import build_scene
    from tricap.core.geometry.rig import Rig, write_rig

    build_scene(small_run.out)
    from mathutils import Vector

    lights = [o for o in empty.data.objects if o.type == "LIGHT"]
    assert len(lights) == 2 and all((o.matrix_world.to_3x3() @ Vector((0, 0, -1))).z < -0.4 for o in lights)
    assert np.abs(world_vertices(empty, empty.data.objects["Floor"])[:, 2]).max() == 0
    write_rig(small_run.take / "rig.toml", Rig(cameras=small_run.rig.cameras, metadata={}))
    build_scene(small_run.out)
    assert "Floor" not in empty.data.objects and sum(o.type == "LIGHT" for o in empty.data.objects) == 2


def test_the_bar_of_a_calibration_moves(empty: ModuleType) -> None:
    from tricap.addon.scene.surroundings import add_bar

    ends = np.random.default_rng(1).uniform(-1, 1, (3, 2, 3))
    bar = add_bar(empty.context.scene.collection, np.array([2, 5, 9]), ends)
    for row, frame in ((0, 2), (2, 9)):
        empty.context.scene.frame_set(frame)
        points = world_vertices(empty, bar)
        assert len(points) and np.linalg.norm(points[:, None] - ends[row], axis=-1).min(axis=1).max() < 0.01
    empty.context.scene.frame_set(4)
    assert not len(world_vertices(empty, bar))


def test_the_bar_beside_the_rig_is_in_the_scene(empty: ModuleType, small_run: SmallRun) -> None:
    """From the scene's first frame on, whatever its own recording counted; one of other cameras is left out and told."""
    from tricap.addon.scene.build import build_scene
    from tricap.core.take.bar_file import bar_path, write_bar

    ends = np.random.default_rng(1).uniform(-1, 1, (3, 2, 3))
    write_bar(small_run.take / "rig.toml", small_run.rig, np.array([100, 101, 104]), ends)
    assert build_scene(small_run.out).counts["positions of the bar"] == 3
    bar, first = empty.data.objects["Reference bar"], empty.context.scene.frame_start
    for row, frame in ((0, first), (2, first + 4)):
        empty.context.scene.frame_set(frame)
        assert np.linalg.norm(world_vertices(empty, bar)[:, None] - ends[row], axis=-1).min(axis=1).max() < 0.01
    path = bar_path(small_run.take / "rig.toml")
    path.write_text(path.read_text().replace("from ", "from another "))
    report = build_scene(small_run.out)
    assert "Reference bar" not in empty.data.objects and any("another calibration" in warning for warning in report.warnings)


@pytest.mark.parametrize("model", ["arm.R", "full"])
def test_in_t_pose_the_person_moves_the_same(empty: ModuleType, model: str) -> None:
    from tricap.addon.scene.rest_pose import with_rest_pose

    shape = default_shape(read_model(model))
    random = np.random.default_rng(3)
    values = random.uniform(-0.6, 0.6, (12, len(shape.skeleton.dof_names)))
    other, new, sigma = with_rest_pose(shape, values, np.full(values.shape, 0.01), "T")
    upper = next(bone for bone in other.skeleton.bones if bone.name == "upper_arm.R")
    np.testing.assert_allclose(upper.R_rest[:, 1], [-1, 0, 0], atol=1e-12)
    for a, b in zip(bone_frames(shape.skeleton, shape.lengths_m, values), bone_frames(other.skeleton, other.lengths_m, new)):
        np.testing.assert_allclose(a, b, atol=2e-6)  # mathutils' Euler angles are single precision
    changed = np.flatnonzero(np.abs(new - values).max(axis=0) > 1e-6)
    assert {shape.skeleton.dof_names[i].partition(" ")[0] for i in changed} <= {"shoulder.R", "shoulder.L"}
    assert np.isfinite(sigma).all() and (sigma > 0).all()
    same = with_rest_pose(shape, values, sigma, "A")
    assert same[0] is shape and same[1] is values


def test_fewer_keys_stay_within_the_tolerance_and_the_measured_motion_is_kept(empty: ModuleType) -> None:
    from tricap.addon.scene import action

    shape = default_shape(read_model("arm.R"))
    frames = np.arange(200)
    phase = frames[:, None] / 40 + np.arange(len(shape.skeleton.dof_names))
    values = 0.4 * np.sin(phase) + np.random.default_rng(0).normal(0, 5e-4, phase.shape)
    values[50] = np.nan
    body = animated(empty, shape, values, frames)
    measured = body.animation_data.action
    simple = action.add_simplified(body, shape, frames, shape.skeleton.dof_names, values, 0.5)
    assert body.animation_data.action == simple and measured.users > 0 and body[action.MEASURED_KEY] == measured
    counted = sum(len(points) for _, _, points in curves(body))
    assert counted < 0.35 * 199 * len(shape.skeleton.dof_names)
    worst = 0.0
    for frame in frames[np.isfinite(values).all(axis=1)]:
        empty.context.scene.frame_set(int(frame))
        upper, fore = (body.pose.bones[name].rotation_euler for name in ("upper_arm.R", "forearm.R"))
        angles = [upper[0], upper[2], upper[1], fore[0]]
        worst = max(worst, float(np.abs(np.degrees(angles) - np.degrees(values[frame, 3:7])).max()))
    assert 0.1 < worst < 0.501


def test_colours_arrows_and_nothing_piles_up(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    from tricap.addon.scene.build import SceneOptions, build_scene

    def census() -> dict[str, list[str]]:
        kinds = "objects meshes armatures actions metaballs materials node_groups movieclips cameras collections".split()
        return {kind: sorted(each.name for each in getattr(empty.data, kind)) for kind in kinds}

    options = SceneOptions(colour="speed", arrows=True, simplify_deg=1.0, exact_skin=True, rest_pose="T", detail=2)
    build_scene(small_run.out, tmp_path / "a.blend", options=options)
    first = census()
    assert {"Velocities", "Exact skin"} <= set(first["objects"]) and len(first["actions"]) == 3
    empty.context.scene.frame_set(FRAMES[2])
    shown = empty.data.objects["Velocities"].evaluated_get(empty.context.evaluated_depsgraph_get()).data
    assert len(shown.polygons) > 0
    speed = [value.value for value in empty.data.objects["Cloud"].data.attributes["speed"].data]
    assert max(speed) > 0
    build_scene(small_run.out, tmp_path / "a.blend", options=options)
    assert census() == first


def test_what_the_filters_removed_is_shown_by_reason(empty: ModuleType, small_run: SmallRun) -> None:
    """Only on request; a removed place is joined to the one before it, in the colour of its reason, and accelerations are arrows."""
    from tricap.addon.scene.build import SceneOptions, write_scene
    from tricap.addon.scene.contents import read_contents
    from tricap.core.foundation import store
    from tricap.core.foundation.errors import InputError
    from tricap.core.foundation.progress import Monitor
    from tricap.core.tracking.settings import TrackStatus

    xyz = np.zeros((3, 2, 3)) + np.arange(3)[:, None, None] * 0.1
    status = np.full((3, 2), TrackStatus.MEASURED, dtype=np.int8)
    status[2, 0], status[1:, 1] = TrackStatus.TOO_FAST, TrackStatus.UNCERTAIN
    path = small_run.out / "trajectories_raw.npz"
    store.save(path, dict(frames=np.arange(3), xyz_m=xyz.astype(np.float32), status=status), {})
    assert read_contents(small_run.out, Monitor()).raw is None
    contents = read_contents(small_run.out, Monitor(), removed=True)
    write_scene(contents, options=SceneOptions(arrows=True))
    mesh = empty.data.objects["Removed trajectories"].data
    assert len(mesh.edges) == 3 and len(mesh.vertices) == 5, "one step of the first point and both of the second"
    reasons = {value.value for value in mesh.attributes["reason"].data}
    assert reasons == {TrackStatus.MEASURED, TrackStatus.TOO_FAST, TrackStatus.UNCERTAIN}
    colours = np.array([value.vector for value in mesh.attributes["colour"].data])
    of = np.array([value.value for value in mesh.attributes["reason"].data])
    assert (colours[of == TrackStatus.TOO_FAST].argmax(axis=1) == 0).all() and (
        colours[of == TrackStatus.UNCERTAIN].argmax(axis=1) == 2
    ).all()
    assert "Accelerations" in empty.data.objects
    store.save(path, dict(frames=np.arange(3), xyz_m=xyz.astype(np.float32), status=np.full((3, 2), 99, dtype=np.int8)), {})
    with pytest.raises(InputError, match="invalid states"):
        read_contents(small_run.out, Monitor(), removed=True)


@pytest.mark.slow
def test_a_whole_body_is_sorted_and_has_parts_of_its_own(empty: ModuleType) -> None:
    from tricap.addon.scene import metaballs, skin

    shape = default_shape(read_model("full"))
    body = animated(empty, shape, np.zeros((1, len(shape.skeleton.dof_names))), np.arange(1))
    names = {c.name for c in body.data.collections}
    assert names == {"Root", "Trunk", "Arm right", "Leg right", "Arm left", "Leg left"}
    flesh = metaballs.add_metaballs(empty.context.scene.collection, body, shape)
    families = [part for part in flesh if len(world_vertices(empty, part))]
    assert len(families) == 8  # trunk, limbs, where both legs meet the pelvis, and each arm the chest
    skin_object = skin.add_skin(empty.context.scene.collection, body, shape, prepared=skin_at_rest("full"))
    assert skin_object.data.uv_layers and all(len(face.vertices) == 4 for face in skin_object.data.polygons)
    np.testing.assert_allclose(world_vertices(empty, skin_object), skin_at_rest("full").vertices_m, atol=2e-5)


@pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")
def test_a_movie_is_not_written_to_the_end_of_a_link(empty: ModuleType, tmp_path: Path) -> None:
    from tricap.addon.scene import movies

    (tmp_path / "letter.txt").write_text("mine")
    (tmp_path / ".t.part.mp4").symlink_to(tmp_path / "letter.txt")
    picture = np.zeros((48, 64, 3), np.uint8)
    movies._write_movie(tmp_path / "t.mp4", [picture] * 2, 2, 25.0)
    assert (tmp_path / "letter.txt").read_text() == "mine" and (tmp_path / "t.mp4").stat().st_size > 100
    with pytest.raises(InputError, match="could not be written whole"):
        movies._write_movie(tmp_path / "lost.mp4", [picture] * 2, 3, 25.0)  # as on a full disk
    assert not (tmp_path / "lost.mp4").exists() and not list(tmp_path.glob(".lost*"))


@pytest.mark.slow
def test_preview_and_turntable(empty: ModuleType, small_run: SmallRun, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from tricap.addon.scene import build, contents, movies, preview
    from tricap.core.foundation.progress import Monitor

    results = contents.read_contents(small_run.out, Monitor())
    build.write_scene(results)
    before = empty.context.scene.camera, empty.context.scene.render.engine, len(empty.data.cameras)
    capfd.readouterr()
    preview.preview(results, tmp_path / "p.png")
    movies.turntable(tmp_path / "t.mp4")
    assert "".join(capfd.readouterr()).strip() == "", "Blender and the graphics driver are not heard"
    assert before == (empty.context.scene.camera, empty.context.scene.render.engine, len(empty.data.cameras))
    picture = cv2.imread(str(tmp_path / "p.png"))
    alone, over = np.split(picture.astype(float), 2, axis=1)
    covered = np.abs(alone - 40).max(axis=2) > 20
    assert 0.01 < covered.mean() < 0.6 and over[~covered].std() > 1
    movie = cv2.VideoCapture(str(tmp_path / "t.mp4"))
    assert int(movie.get(cv2.CAP_PROP_FRAME_COUNT)) == 48


@pytest.mark.parametrize("movie", ["film", "turntable"])
def test_movies_show_the_texture(empty: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, movie: str) -> None:
    """And leave the shading as it was."""
    from tricap.addon.scene import movies

    scene = empty.context.scene
    scene.frame_start = scene.frame_end = 1
    armature = empty.data.objects.new("Body", empty.data.armatures.new("Body"))
    scene.collection.objects.link(armature)
    shading, seen = scene.display.shading, set()
    before = shading.color_type

    def pictured(scene: object) -> np.ndarray:
        seen.add(shading.color_type)
        return np.zeros((48, 64, 3), dtype=np.uint8)

    monkeypatch.setattr(movies, "_picture", pictured)
    monkeypatch.setattr(movies, "_extent", lambda scene, frames: (armature.location, 1.0))
    arguments = dict(start_deg=0.0, turn_deg=0.0, elevation_deg=0.0) if movie == "film" else {}
    getattr(movies, movie)(tmp_path / "m.mp4", **arguments)
    assert seen == {"TEXTURE"} and shading.color_type == before


@pytest.mark.slow
def test_a_film_of_the_scene_shows_every_frame_from_another_side(empty: ModuleType, small_run: SmallRun, tmp_path: Path) -> None:
    """Without --blend only the movie is written; the camera circles, and leaves no trace in the scene; a stopped film is no film."""
    from tricap.addon.scene import build, movies

    assert main(["scene", str(small_run.out), "--film", str(tmp_path / "f.mp4"), "--turn", "180", "--quiet"]) == 0
    movie, scene = cv2.VideoCapture(str(tmp_path / "f.mp4")), empty.context.scene
    pictures = [movie.read()[1].astype(float) for _ in range(scene.frame_start, scene.frame_end + 1)]
    assert not movie.read()[0] and len(pictures) == int(movie.get(cv2.CAP_PROP_FRAME_COUNT)) > 1
    assert movie.get(cv2.CAP_PROP_FPS) == pytest.approx(scene.render.fps / scene.render.fps_base)
    bright = [picture.max(axis=2) > 120 for picture in pictures]  # the body; the floor is darker
    assert all(0.005 < b.mean() < 0.5 and not (b[0].any() or b[:, 0].any() or b[:, -1].any()) for b in bright)
    assert np.abs(pictures[0] - pictures[-1]).max(axis=2)[bright[0] | bright[-1]].mean() > 20
    assert [path.name for path in tmp_path.glob("*.*4")] == ["f.mp4"]
    build.build_scene(small_run.out)
    before, monitor = (scene.camera, scene.frame_current, scene.render.resolution_x, len(empty.data.cameras)), Monitor()
    monitor.cancel()
    with pytest.raises(Cancelled):
        movies.film(tmp_path / "g.mp4", monitor, start_deg=0.0, turn_deg=0.0, elevation_deg=0.0)
    assert before == (scene.camera, scene.frame_current, scene.render.resolution_x, len(empty.data.cameras))
    assert [path.name for path in tmp_path.glob("*.*4")] == ["f.mp4"]
