"""From an empty Blender to a character that moves, by mouse and keys alone: footage, cameras, clicks, surface, tracks, body, rig,
retargeting, export, an edit of the character and its export; then the same numbers by the command line."""

import math
import random
import subprocess
import time
from pathlib import Path

import addon_utils
import bpy
import display
import drive
from bl_ext.user_default.tricap.core.motion.formats.bvh import read_bvh
from bl_ext.user_default.tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from bl_ext.user_default.tricap.core.take.take import read_take
from mathutils import Vector

CLICK_ERROR_PX, SNAP_PX = 5.0, 6.0
LAYOUT, CLICKS = "Layout", "Tricap Clicks"
EXPORT_UP_PX = 56  # from the field Source to the menu of formats: two rows
MET_DEG = 0.1  # between a limb of the body and the character's
EDITED_FRAME, EDITED_DEG = 3, 5.0  # where the character's forearm is turned by hand, and by how much at least
READ_BACK_M, READ_BACK_DEG = 1e-4, 0.1  # of the file with the edited character
COMPARED = ("motion.csv", "joints.csv", "body.toml", "trajectories.npz", "clouds/0000.ply")
STAGE_S = 120.0
Joints = dict[str, dict[str, tuple[float, float]]]


def steps() -> drive.Steps:
    film, blend = drive.HERE / "film", drive.HERE / "mon élan" / "kick.blend"
    blend.parent.mkdir()
    joints = make_film(film)
    yield from footage(film, blend)
    yield from cameras(film)
    yield from seeds(joints)
    yield from body()
    yield from onto_a_character()
    yield from exported(blend.with_name("kick.bvh"))
    yield from edited(blend.with_name("character.bvh"))
    yield from saved()
    yield from commands_numbers(blend.with_name("kick_tricap"), blend.with_name("kick.bvh"))


def make_film(film: Path) -> Joints:
    """A folder of images for every view, rig.toml elsewhere, and where the joints are in the images."""
    make_arm_take(film, ArmTakeSettings(frames=6, width_px=512, interlaced="none", click_error_px=0.0))
    joints = read_take(film).clicks.joints
    for name in ("take.toml", "truth.npz"):
        (film / name).unlink()
    (film / "rig.toml").rename(film.with_name("rig.toml"))  # a calibration next to the footage would be used at once
    return {name: {view: (float(xy[0]), float(xy[1])) for view, xy in at.items()} for name, at in joints.items()}


def footage(film: Path, blend: Path) -> drive.Steps:
    """Save the file; choose the folder with the footage."""
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    yield from drive.shot("01_empty")
    yield from drive.press(area, "wm.save_mainfile")
    yield from drive.choose("save", blend.parent, blend.name)
    drive.need(bpy.data.filepath == str(blend), "the file is saved")
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    yield from drive.shot("02_saved")
    yield from drive.press(area, "tricap.add_footage")
    yield from drive.choose("footage", film)
    yield from drive.shot("03_footage")
    drive.check(bpy.context.scene.frame_current == 0, "the first frame is shown")
    drive.need([view.name for view in bpy.context.scene.tricap.views] == ["L", "C", "R"], "three views were added")


def cameras(film: Path) -> drive.Steps:
    """Choose the calibration."""
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    yield from drive.press(area, "tricap.cameras_from_file")
    yield from drive.choose("cameras", film.parent, "rig.toml")
    yield from drive.shot("04_cameras")


def seeds(wanted: Joints) -> drive.Steps:
    """Choose the body, open the views, click every joint in every view, each a little beside it."""
    area, props = (yield from drive.sidebar("VIEW_3D", "Tricap")), bpy.context.scene.tricap
    bpy.context.window_manager.tricap_steps.clicks = True  # a whole person needs no clicks, so that this step is folded
    yield from drive.settle()
    yield from drive.pick(area, "tricap.model", props, "model", "arm.R")
    yield from drive.press(area, "tricap.click_joints")
    yield from drive.wait_for(lambda: drive.window().workspace.name == CLICKS, 10, "the views are opened")
    yield from drive.wait_for(lambda: len(clip_areas()) == 3, 10, "each view has an editor")
    yield from drive.settle(20)
    yield from drive.shot("05_clicking")
    rng = random.Random(3)
    for name, at in wanted.items():
        for area in clip_areas():
            x, y = at[view_of(area)]
            yield from drive.click(*display.image_place(area, x + beside(rng), y + beside(rng)))
            yield from drive.pause(0.5)
            if name == "elbow.R" and area == clip_areas()[0]:
                yield from drive.pause(3)
                yield from drive.shot("06_one_view_clicked")
    yield from drive.settle(10)
    check_clicks(wanted)
    yield from drive.shot("07_clicked")
    yield from drive.press(clip_areas()[0], "back_to_steps()", "HEADER")
    yield from drive.wait_for(lambda: drive.window().workspace.name == LAYOUT, 10, "the button leads back to the steps")


def beside(rng: random.Random) -> float:
    """A person's error in x or y [px]."""
    return rng.uniform(-1, 1) * CLICK_ERROR_PX / 2**0.5


def clip_areas() -> list[bpy.types.Area]:
    """The Clip Editors, from left to right."""
    return sorted((a for a in drive.window().screen.areas if a.type == "CLIP_EDITOR"), key=lambda a: a.x)


def view_of(area: bpy.types.Area) -> str:
    """The view that an editor shows."""
    return next(view.name for view in bpy.context.scene.tricap.views if view.clip == area.spaces.active.clip)


def check_clicks(wanted: Joints) -> None:
    """Each joint is clicked in each view, as close as it was meant to be, or on the ring to which it snapped, to a screen pixel."""
    for n, view in enumerate(bpy.context.scene.tricap.views):
        size, tracks, areas = view.clip.size, view.clip.tracking.tracks, {view_of(a): a for a in clip_areas()}
        pixel = 1 / display.pixel_of(areas[view.name])
        limit_px = CLICK_ERROR_PX + pixel * (1 + (SNAP_PX if n else 0))
        for name, at in wanted.items():
            co = tracks[name].markers[0].co if name in tracks else (0.0, 0.0)
            off = max(abs(co[0] * size[0] - 0.5 - at[view.name][0]), abs((1 - co[1]) * size[1] - 0.5 - at[view.name][1]))
            drive.check(off <= limit_px, f"{name} in {view.name} is clicked {off:.1f} px beside it")


def body() -> drive.Steps:
    """Surface, tracks, body, rig, one button each."""
    for operator in ("tricap.measure(", "tricap.track(", "tricap.fit(", "tricap.build_scene("):
        area = yield from drive.sidebar("VIEW_3D", "Tricap")
        yield from drive.press(area, operator)
        yield from drive.wait_for(lambda: not bpy.context.window_manager.tricap.running, STAGE_S, f"{operator}) ends")
        yield from drive.shot(f"1_{operator[7:-1]}")
    drive.need("Body" in bpy.data.objects, "there is a body")
    armature, scene = bpy.data.objects["Body"], bpy.context.scene
    yield from drive.move(*drive.middle(drive.area_of("VIEW_3D")))
    yield from drive.key("LEFT_ARROW", shift=True)
    start = (armature.matrix_world @ armature.pose.bones[-1].tail).copy()
    yield from drive.key("RIGHT_ARROW", shift=True)
    yield from drive.settle()
    path = (armature.matrix_world @ armature.pose.bones[-1].tail - start).length
    drive.check(scene.frame_current == scene.frame_end, "the last frame is shown")
    drive.check(path > 0.02, f"from the first frame to the last the wrist moves {path * 1e3:.0f} mm")
    yield from drive.shot("2_moving")


def onto_a_character() -> drive.Steps:
    """The body is the source already; choose the target, press Retarget: the character's arm has the body's directions in every frame."""
    source, target = bpy.data.objects["Body"], character()
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    drive.check(bpy.context.scene.tricap_retarget.source == source, "the body is chosen as the source")
    yield from drive.look_up(area, "tricap_retarget.target", target.name)
    drive.need(bpy.context.scene.tricap_retarget.target == target, "the character is chosen as the target")
    yield from drive.press(area, "tricap.retarget()")
    yield from drive.wait_for(lambda: not bpy.context.window_manager.tricap.running, STAGE_S, "the retargeting ends")
    drive.need(target.animation_data and target.animation_data.action, "the character has an action")
    scene, off = bpy.context.scene, []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        off += [direction(source, bone).angle(direction(target, bone)) for bone in ("upper_arm.R", "forearm.R")]
    worst = math.degrees(max(off))
    drive.check(worst < MET_DEG, f"over {len(off) // 2} frames the character's arm is off by {worst:.3f}° at most")
    yield from drive.move(*drive.middle(drive.area_of("VIEW_3D")))
    yield from drive.key("NUMPAD_PERIOD")
    yield from drive.settle(20)
    yield from drive.shot("3_character")


def character() -> bpy.types.Object:
    """A person of Blender's own, Rigify's."""
    addon_utils.enable("rigify", default_set=True)
    bpy.ops.object.armature_basic_human_metarig_add()
    made = bpy.context.object
    made.name, made.location = "Character", (0.8, 0.0, 0.0)
    bpy.ops.ed.undo_push(message="Character")
    return made


def direction(armature: bpy.types.Object, bone: str) -> Vector:
    """Of a posed bone, in the world."""
    posed = armature.pose.bones[bone]
    return armature.matrix_world.to_3x3() @ (posed.tail - posed.head)


def exported(file: Path) -> drive.Steps:
    """The measured motion as BVH, by the menu and the file browser; then all steps are done."""
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    bpy.context.scene.tricap_retarget.export_source = "MEASURED"  # as the command exports it
    yield from drive.settle()
    yield from drive.take_item(area, "tricap_retarget.source", EXPORT_UP_PX, 1)
    yield from drive.choose("export", file.parent, file.name)
    yield from drive.wait_for(file.is_file, STAGE_S, "the file is written")
    text = file.read_text()
    scene = bpy.context.scene
    drive.check(f"Frames: {scene.frame_end - scene.frame_start + 1}" in text and "forearm.R" in text, "it has all frames, and the arm")
    yield from drive.settle()
    yield from drive.shot("4_all_done")


def edited(file: Path) -> drive.Steps:
    """Turn the character's forearm in one frame, key it, and export what plays: the file has the edited motion."""
    scene, target, area = bpy.context.scene, bpy.data.objects["Character"], drive.area_of("VIEW_3D")
    for thing in scene.objects:
        thing.select_set(thing == target)
    bpy.context.view_layer.objects.active = target
    with drive.override(window=drive.window(), area=area, region=drive.region_of(area)):
        bpy.ops.object.mode_set(mode="POSE")
    target.data.bones.active = target.data.bones["forearm.R"]
    selected = target.pose.bones if bpy.app.version >= (5, 0) else target.data.bones
    for bone in selected:
        bone.select = bone.name == "forearm.R"
    scene.frame_set(EDITED_FRAME)
    yield from drive.settle()
    before = direction(target, "forearm.R")
    x, y = drive.middle(area)
    yield from drive.move(x, y)
    yield from drive.key("R")
    for step in range(8):
        yield from drive.move(x, y + 12 * step)
    yield from drive.click(x, y + 84)
    yield from drive.key("I")
    turned = math.degrees(before.angle(direction(target, "forearm.R")))
    drive.check(turned > EDITED_DEG, f"the forearm was turned by {turned:.1f}°")
    yield from drive.shot("5_edited")
    scene.tricap_retarget.export_source, scene.tricap_retarget.export = "PLAYED", target
    area = yield from drive.sidebar("VIEW_3D", "Tricap")
    yield from drive.take_item(area, "tricap_retarget.source", EXPORT_UP_PX, 1)
    yield from drive.choose("export", file.parent, file.name)
    yield from drive.wait_for(file.is_file, STAGE_S, "the character's motion is written")
    read_back(file, target)


def read_back(file: Path, target: bpy.types.Object) -> None:
    """The file plays as the character does."""
    found, scene = read_bvh(file, unit_m=1.0, up="Y"), bpy.context.scene
    off_m, off_deg = [], []
    for row, frame in enumerate(range(scene.frame_start, scene.frame_end + 1)):
        scene.frame_set(frame)
        for name, next_name in (("upper_arm.R", "forearm.R"), ("forearm.R", "hand.R")):
            here, there = (Vector(found.head_m[row, found.rig.index[each]]) for each in (name, next_name))
            off_m.append((target.matrix_world @ target.pose.bones[name].head - here).length)
            off_deg.append(math.degrees(direction(target, name).angle(there - here)))
    drive.check(max(off_m) < READ_BACK_M and max(off_deg) < READ_BACK_DEG, f"read back, off by {max(off_m):.1e} m, {max(off_deg):.1e}°")


def saved() -> drive.Steps:
    """Ctrl S."""
    yield from drive.move(*drive.middle(drive.area_of("VIEW_3D")))
    yield from drive.key("S", ctrl=True)
    yield from drive.settle()
    drive.check(not bpy.data.is_dirty, "the file is saved with it")


def commands_numbers(project: Path, bvh: Path) -> drive.Steps:
    """`tricap run` on the take.toml that the clicks made gives the same bytes, and `tricap export` of its result the same file."""
    out, file = drive.HERE / "command", drive.HERE / "command.bvh"
    yield from by_command("run", str(project), "--out", str(out), "--quiet")
    yield from by_command("export", str(out), "--format", "bvh", "--out", str(file))
    drive.check(file.read_bytes() == bvh.read_bytes(), "the exported motion is the command line's, byte by byte")
    for name in COMPARED:
        same = (out / name).read_bytes() == (project / "results" / name).read_bytes()
        drive.check(same, f"{name} is the command line's, byte by byte")
    (drive.OUT / "take.toml").write_bytes((project / "take.toml").read_bytes())


def by_command(*words: str) -> drive.Steps:
    """The `tricap` command, beside this Blender."""
    began, command = time.monotonic(), subprocess.Popen(drive.command(*words))
    yield from drive.wait_for(lambda: command.poll() is not None, 3 * STAGE_S, f"the command {words[0]} ends")
    drive.check(command.returncode == 0, f"it took {time.monotonic() - began:.1f} s, exit code {command.returncode}")
