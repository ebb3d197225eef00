"""Blender cameras with the poses and lenses of the calibrated cameras."""

import bpy
import numpy as np
from mathutils import Matrix

from ...core.geometry.camera import Camera
from ...core.geometry.rig import Rig
from . import axes
from .fisheye import nearest_brown

DISPLAY_SIZE = 0.2  # of the camera's frame in the viewport, metres
ASPECT_TOLERANCE_PX = 0.05
FISHEYE_TOLERANCE_PX = 0.5
SIZE_KEY = "tricap_size_px"  # custom property of a camera: width and height of its images


def add_camera(collection: bpy.types.Collection, camera: Camera) -> bpy.types.Object:
    """A Blender camera at the place, in the direction and with the lens of `camera`; distortion belongs to its clip."""
    lens = axes.lens(camera)
    data = bpy.data.cameras.new(f"Camera {camera.name}")
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", lens.sensor_width_mm, lens.lens_mm
    data.sensor_height = lens.sensor_width_mm * camera.size_px[1] / camera.size_px[0]
    data.shift_x, data.shift_y = lens.shift_x, lens.shift_y
    data.clip_start, data.clip_end, data.display_size = 0.01, 1000.0, DISPLAY_SIZE
    data.show_passepartout = True
    camera_object = bpy.data.objects.new(data.name, data)
    camera_object.matrix_world = Matrix(axes.camera_to_world(camera))
    camera_object["tricap_view"] = camera.name
    camera_object[SIZE_KEY] = list(camera.size_px)
    camera_object.lock_location = camera_object.lock_rotation = camera_object.lock_scale = (True, True, True)
    collection.objects.link(camera_object)
    return camera_object


def frame_render(scene: bpy.types.Scene, reference: Camera) -> None:
    """Render size and pixel aspect of the scene as the reference camera's picture."""
    scene.render.resolution_x, scene.render.resolution_y = reference.size_px
    scene.render.resolution_percentage = 100
    aspect = axes.lens(reference).pixel_aspect_y
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1.0, 1.0 / aspect), max(1.0, aspect)


def frame_faults(rig: Rig, reference: Camera) -> list[str]:
    """Warnings about cameras whose pictures cannot be shown exactly: a Blender scene has only one render size and pixel aspect."""
    faults = []
    w, h = reference.size_px
    for camera in rig.cameras:
        if camera.fisheye and (off_px := nearest_brown(camera)[1]) > FISHEYE_TOLERANCE_PX:
            faults.append(
                f"Camera {camera.name} has a fisheye lens, which Blender's clips show only approximately: the footage behind it is up to "
                f"{off_px:.1f} px off. Compare body and footage in the Clip Editor, where they agree."
            )
        if camera.size_px[0] * h != camera.size_px[1] * w:
            faults.append(
                f"Camera {camera.name} has another aspect ratio than {reference.name};"
                " set the scene's resolution to its own to look through it."
            )
            continue
        off_px = abs(axes.lens(camera).pixel_aspect_y / axes.lens(reference).pixel_aspect_y - 1.0) * camera.size_px[1] / 2
        if off_px > ASPECT_TOLERANCE_PX:
            faults.append(f"Camera {camera.name} has another pixel aspect than {reference.name}: up to {off_px:.1f} px off at the border.")
        if abs(camera.affinity[1]) * camera.size_px[1] / 2 > ASPECT_TOLERANCE_PX:
            faults.append(f"Camera {camera.name} has a shear that a Blender camera cannot show.")
    return faults


def look_through() -> None:
    """Let every 3D Viewport look through the scene's camera and show the materials' textures and colours."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                space = area.spaces.active
                space.region_3d.view_perspective = "CAMERA"
                space.shading.color_type = "TEXTURE"  # where there is none, the material's colour


def projected(scene: bpy.types.Scene, camera_object: bpy.types.Object, xyz_m: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Pixels (N, 2) of world points (N, 3) as the Blender camera itself projects them (without distortion)."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    uv = np.array([world_to_camera_view(scene, camera_object, Vector(point))[:2] for point in np.asarray(xyz_m)])
    return axes.pixel_from_uv(uv, size_px)
