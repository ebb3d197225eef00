"""Keys of some frames of an armature alone: the frames before and after them keep what they play.

A key changes its curve up to the keys next to it, and without such keys everywhere. So each channel also gets a key with what it plays in
the frame before the first and in the frame after the last one; between the keys next to these and them, the curve is divided without a
change of its shape. Blender inserts the keys, because what an action in an NLA stack has to play depends on the layers below it.
"""

from collections.abc import Mapping, Sequence

import bpy

from ..scene.action_curves import curves_of

Channel = tuple[str, str]  # bone, and path of one of its channels or custom properties, such as '["IK_FK"]'
Pose = dict[Channel, object]
CHANNELS = ("location", "rotation_quaternion", "rotation_euler", "rotation_axis_angle", "scale")


def pose_of(rig: bpy.types.Object) -> Pose:
    """All channels of an armature as they are now, with the custom properties that are numbers."""
    found: Pose = {}
    for bone in rig.pose.bones:
        found |= {(bone.name, path): tuple(getattr(bone, path)) for path in CHANNELS}
        found |= {(bone.name, f'["{bpy.utils.escape_identifier(name)}"]'): v for name, v in bone.items() if isinstance(v, (int, float))}
    return found


def values_of(channels: Sequence[Channel], pose: Pose) -> Pose:
    """Some channels of a pose, in their order."""
    return {channel: pose[channel] for channel in channels}


def put(rig: bpy.types.Object, pose: Mapping[Channel, object]) -> None:
    """Pose an armature; Blender evaluates it with its next update."""
    for (bone_name, path), value in pose.items():
        bone = rig.pose.bones[bone_name]
        if path in CHANNELS:
            setattr(bone, path, value)
        else:
            bone[bpy.utils.unescape_identifier(path[2:-2])] = value


def key_frames(rig: bpy.types.Object, frames: Sequence[int], values: Sequence[Pose]) -> None:
    """Key channels in successive frames, each with a pose of the same channels, as it is to play over the layers below.

    The pose before, with its channels that have no keys, is that of the other frames. The scene shows the last of the frames afterwards.
    """
    scene, channels = bpy.context.scene, list(values[0])
    before, after = frames[0] - 1, frames[-1] + 1
    for at in (after, before):
        scene.frame_set(at)
        for channel in channels:
            _key_unchanged(rig, channel, at)
    scene.frame_set(frames[0])
    for frame, pose in zip(frames, values, strict=True):
        put(rig, pose)
        for bone, path in channels:
            rig.pose.bones[bone].keyframe_insert(path, frame=frame, group=bone)
    for curve in _curves(rig, channels):
        for point in curve.keyframe_points:
            if before <= point.co.x <= frames[-1]:
                point.interpolation = "LINEAR" if point.co.x in frames[:-1] else "CONSTANT"
    scene.frame_set(frames[-1])


def _key_unchanged(rig: bpy.types.Object, channel: Channel, frame: int) -> None:
    """Key a channel with what it plays in the frame that is shown; a curve that it has keeps its shape."""
    bone, path = rig.pose.bones[channel[0]], channel[1]
    earlier = {curve.array_index: (curve.evaluate(frame), _divided(curve, frame)) for curve in _curves(rig, [channel])}
    if len(earlier) < (len(getattr(bone, path)) if path in CHANNELS else 1):
        bone.keyframe_insert(path, frame=frame, group=channel[0])
    for curve in _curves(rig, [channel]):
        if curve.array_index in earlier:
            value, interpolation = earlier[curve.array_index]
            key = curve.keyframe_points.insert(frame, value)
            key.handle_left_type = key.handle_right_type = "FREE"
            key.interpolation = interpolation
            curve.update()


def _divided(curve: bpy.types.FCurve, frame: int) -> str:
    """Let the keys next to a frame keep their handles when a key is inserted between them; the interpolation of the new key."""
    earlier = [point for point in curve.keyframe_points if point.co.x <= frame]
    later = [point for point in curve.keyframe_points if point.co.x > frame]
    for point in (*earlier[-1:], *later[:1]):
        point.handle_left_type = point.handle_right_type = "FREE"
    if earlier and later:
        return str(earlier[-1].interpolation)
    if earlier and earlier[-1].co.x < frame:
        earlier[-1].interpolation = "LINEAR"  # the last one: the curve is constant from there on
    return "LINEAR"


def _curves(rig: bpy.types.Object, channels: Sequence[Channel]) -> list[bpy.types.FCurve]:
    """The curves of channels in the action that gets the keys."""
    action = rig.animation_data.action if rig.animation_data is not None else None
    paths = {rig.pose.bones[bone].path_from_id() + (path if path.startswith("[") else f".{path}") for bone, path in channels}
    return [curve for curve in curves_of(action) if curve.data_path in paths] if action is not None else []
