"""The skeleton: conventions, derivatives, mirror images, and the papers' form of the same motion."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.model_file import MODELS, mirrored, model_names, other_side, read_model, without
from tricap.core.body.skeleton import Bone, Dof, Skeleton, bone_frames, frames_and_axes, frames_of_bones, joint_positions
from tricap.core.foundation.errors import InputError
from tricap.core.geometry.rotation import axis_rotation

RNG = np.random.default_rng(0)


def _lengths(skeleton: Skeleton) -> np.ndarray:
    return np.array([bone.nominal_length_m for bone in skeleton.bones])


def test_rest_pose_is_the_rest_frames() -> None:
    skeleton = read_model("arm.R").skeleton
    R, head = bone_frames(skeleton, _lengths(skeleton), np.zeros(8))
    assert np.allclose(R, [bone.R_rest for bone in skeleton.bones])
    assert np.allclose(head[0], 0)
    assert np.allclose(head[1], _lengths(skeleton)[0] * skeleton.bones[0].R_rest[:, 1])


def test_positive_flexion_is_the_natural_one() -> None:
    for model, joint, forward in (("arm.R", "wrist.R", -1), ("arm.L", "wrist.L", -1), ("leg.R", "ankle.R", 1), ("leg.L", "ankle.L", 1)):
        skeleton = read_model(model).skeleton
        motion = np.zeros(8)
        name = next(n for n in skeleton.dof_names if n.startswith(("elbow", "knee")) and n.endswith("flexion"))
        motion[skeleton.layout[name]] = 0.5
        moved = joint_positions(skeleton, _lengths(skeleton), motion)[joint][1]
        assert np.sign(moved) == forward, "the person faces -Y: forearms bend to the front, shins to the back"


def test_bone_rotation_is_blenders_euler_matrix() -> None:
    skeleton = read_model("arm.R").skeleton
    motion = RNG.normal(0, 0.5, 8)
    flexion, abduction, twist = motion[3:6]
    R, _ = bone_frames(skeleton, _lengths(skeleton), motion)
    euler = axis_rotation("x", flexion) @ axis_rotation("z", abduction) @ axis_rotation("y", twist)  # Blender's mode YZX
    assert np.allclose(R[0], skeleton.bones[0].R_rest @ euler)


def test_the_papers_chain_is_the_same_motion() -> None:
    """X_j = D_n … D_1 X_w with D_k = Rot_z(θ_k) · D_ini,k (Eqs. 2, 3): each D_ini,k turns the DOF's axis into z, world to local."""
    skeleton, lengths = read_model("arm.R").skeleton, _lengths(read_model("arm.R").skeleton)
    motion = RNG.normal(0, 0.5, 8)
    R, head = bone_frames(skeleton, lengths, motion)
    X = RNG.normal(0, 1, 3)
    into_z = {"x": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]]), "y": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]]), "z": np.eye(3)}
    point, k = X - motion[:3], 3  # s·T of the first joint is the base
    axes_before = np.eye(3)  # how the frame so far is permuted from the bone's own axes
    for bone, R_rel in zip(skeleton.bones, (skeleton.bones[0].R_rest, skeleton.bones[0].R_rest.T @ skeleton.bones[1].R_rest)):
        if bone.parent:
            point = axes_before.T @ point - np.array([0, lengths[0], 0])  # the elbow's offset along the upper arm
            axes_before = np.eye(3)
        static = R_rel.T
        for axis in bone.rotation_mode.lower()[::-1]:
            index = [i for i, dof in enumerate(bone.dofs) if dof.axis == axis]
            if not index:
                continue
            D_ini = into_z[axis] @ axes_before.T @ static
            point = axis_rotation("z", -motion[k + index[0]]) @ (D_ini @ point)
            axes_before, static = into_z[axis], np.eye(3)
        k += len(bone.dofs)
    assert np.allclose(axes_before.T @ point, R[1].T @ (X - head[1]))


@pytest.mark.parametrize("model", model_names())
def test_axes_are_the_derivatives_of_joints(model: str) -> None:
    skeleton = read_model(model).skeleton
    n = len(skeleton.dofs)
    lengths, motion, h = _lengths(skeleton), RNG.normal(0, 0.4, n), 1e-6
    _, head, axes = frames_and_axes(skeleton, lengths, motion)
    bone = skeleton.bones[-1]
    X = joint_positions(skeleton, lengths, motion)[bone.tail_joint]
    for k, name in enumerate(skeleton.dof_names):
        step = np.eye(n)[k] * h
        there, back = (joint_positions(skeleton, lengths, motion + s)[bone.tail_joint] for s in (step, -step))
        difference = (there - back) / (2 * h)
        wanted = axes[k] if k < 3 else np.cross(axes[k], X - head[skeleton.dof_bone[k]])
        moves = k < 3 or skeleton.moved_by[-1, k]
        assert np.allclose(difference, wanted if moves else 0.0, atol=1e-8), name


def test_many_postures_at_once_are_the_postures_one_by_one() -> None:
    skeleton = read_model("leg.R").skeleton
    motions = RNG.normal(0, 0.4, (2, 3, 8))
    R, head = bone_frames(skeleton, _lengths(skeleton), motions)
    one = bone_frames(skeleton, _lengths(skeleton), motions[1, 2])
    assert np.allclose(R[1, 2], one[0]) and np.allclose(head[1, 2], one[1])


def test_some_bones_are_where_they_are_among_all() -> None:
    """Also if the poses differ in the bones before these, or in the place of the body."""
    skeleton = read_model("full").skeleton
    lengths, bones = _lengths(skeleton), np.flatnonzero([bone.name in ("forearm.R", "hand.R") for bone in skeleton.bones])
    for columns in (["elbow.R flexion"], ["elbow.R flexion", "shoulder.R twist"], ["pelvis x"]):
        motion = np.tile(RNG.normal(0, 0.5, len(skeleton.dof_names)), (5, 1))
        motion[:, [skeleton.layout[name] for name in columns]] += RNG.normal(0, 0.5, (5, len(columns)))
        for some, every in zip(frames_of_bones(skeleton, lengths, motion, bones), bone_frames(skeleton, lengths, motion)):
            assert np.allclose(some, every[:, bones], rtol=0, atol=1e-14)


def test_a_whole_body_is_its_own_mirror_image() -> None:
    model = read_model("full")
    other = mirrored(model, "full")
    names, lengths = model.skeleton.joint_names, _lengths(model.skeleton)
    motion = RNG.normal(0, 0.3, len(model.skeleton.dofs))
    signs = np.array(
        [-1 if dof.axis == "x" else 1 for dof in model.skeleton.base_dofs]
        + [1 if dof.axis == "x" else -1 for dof in model.skeleton.dofs[3:]]
    )
    a = joint_positions(model.skeleton, lengths, motion)
    b = joint_positions(other.skeleton, lengths, motion * signs)
    for name in names:
        assert np.allclose(b[other_side(name)], a[name] * [-1, 1, 1]), name
    assert set(other.skeleton.joint_names) == set(names) and set(other.skeleton.dof_names) == set(model.skeleton.dof_names)


def test_rest_pose_of_a_person() -> None:
    """A person of 1.75 m: facing -Y, the right side -X, arms 45° down, legs straight; 44 to 49 DOF."""
    skeleton = read_model("full").skeleton
    assert len(skeleton.dofs) == 49
    rest = joint_positions(skeleton, _lengths(skeleton), np.zeros(49))
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe"):
        assert rest[f"{joint}.R"][0] < 0 < rest[f"{joint}.L"][0]
    assert np.allclose(rest["elbow.R"] - rest["shoulder.R"], [-0.2005, 0, -0.2005], atol=1e-3)
    assert rest["toe.R"][1] < -0.1, "the person faces -Y"
    height = rest["crown"][2] - rest["toe.R"][2]
    assert 1.70 < height < 1.80
    above = {j for j in skeleton.joint_names if j[:-2] not in ("hip", "knee", "ankle", "toe")}
    assert set(read_model("upper_body").skeleton.joint_names) == above


def test_what_hangs_on_a_rigid_part_meets_what_the_part_belongs_to() -> None:
    skeleton = read_model("full").skeleton
    index = {bone.name: b for b, bone in enumerate(skeleton.bones)}
    meet = skeleton.neighbours
    assert meet[index["thigh.R"], index["pelvis"]] and meet[index["pelvis"], index["thigh.L"]]
    assert not meet[index["thigh.R"], index["thigh.L"]] and not meet[index["upper_arm.R"], index["chest"]]
    assert (meet == meet.T).all()


def test_a_model_without_bones_that_it_does_not_have_is_refused() -> None:
    with pytest.raises(InputError, match="hip.r.*nearest|hip.R"):
        without(read_model("full"), ["hip.r"], "half")


@pytest.mark.parametrize("side", ["arm", "leg"])
def test_left_is_the_mirror_image_of_right(side: str) -> None:
    right, left = read_model(f"{side}.R"), read_model(f"{side}.L")
    motion = RNG.normal(0, 0.4, 8)
    signs = np.array(
        [-1 if dof.axis == "x" else 1 for dof in right.skeleton.base_dofs]
        + [1 if dof.axis == "x" else -1 for dof in right.skeleton.dofs[3:]]
    )
    a = joint_positions(right.skeleton, _lengths(right.skeleton), motion)
    b = joint_positions(left.skeleton, _lengths(left.skeleton), motion * signs)
    for name, X in a.items():
        assert np.allclose(b[name.replace(".R", ".L")], X * [-1, 1, 1]), name
    again = mirrored(left, right.name)
    assert [d.limits for d in again.skeleton.dofs] == [d.limits for d in right.skeleton.dofs]


def test_usual_places_of_joints_are_on_both_sides_and_go_with_their_joints() -> None:
    model = read_model("full")
    assert model.joint_places_m["neck"][1] > 0 and {"ankle.R", "ankle.L"} <= set(model.joint_places_m)
    for other in (mirrored(model, "full"), model):
        for joint, place in other.joint_places_m.items():
            assert np.allclose(model.joint_places_m[other_side(joint)], place * [-1, 1, 1]), joint
    upper = read_model("upper_body")
    assert set(upper.joint_places_m) == set(model.joint_places_m) & set(upper.skeleton.joint_names) < set(model.joint_places_m)
    assert not read_model("arm.R").joint_places_m


@pytest.mark.parametrize(("line", "said"), [("nekc = [0.0, 0.0, 0.0]", "nekc.*neck"), ("neck = [0.0, 0.0]", "place of neck")])
def test_a_faulty_place_of_a_joint_is_refused(tmp_path: Path, line: str, said: str) -> None:
    text = (MODELS / "full.toml").read_text().replace("neck = [0.0, 0.033, 0.0]", line)
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        read_model(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("entry", "wrong", "said"),
    [
        ("length_per_stature = 0.186", "length_per_stature = nan", "Bone “upper_arm.R” is nan m long"),
        ("length_per_stature = 0.186", "length_per_stature = 1e300", "Bone “upper_arm.R” is .* m long"),
        ("length_per_stature = 0.186", "length_per_stature = -1", "Bone “upper_arm.R” is -1.75 m long"),
        ("[-90.0, 200.0]", "[200.0, -90.0]", "“shoulder.R flexion” goes from 3.491 to -1.571"),
        ("prior_sigma_deg = 60.0", "prior_sigma_deg = 0", "“shoulder.R twist”.*sigma above 0"),
        ("radii_m = [0.052, 0.046, 0.041]", "radii_m = [0, 0, 0]", "radii_m of “upper_arm.R”"),
        ("radii_m = [0.052, 0.046, 0.041]", "radii_m = [1e9, 1, 1]", "radii_m of “upper_arm.R”"),
        ("radii_m = [0.052", "radius_sigma = 2\nradii_m = [0.052", "radius_sigma of “upper_arm.R” is no share"),
        ("surface = [", "surface = [0.9, 0.3] # [", "surface of “upper_arm.R” is 0.9 to 0.3"),
        ('base = "', 'base = "zz" # "', "base is .*zz.*shoulder.R"),
    ],
)
def test_a_model_of_no_body_is_refused_when_it_is_read(tmp_path: Path, entry: str, wrong: str, said: str) -> None:
    text = (MODELS / "arm.R.toml").read_text()
    assert entry in text
    (tmp_path / "mine.toml").write_text(text.replace(entry, wrong, 1))
    with pytest.raises(InputError, match=f"mine.toml.*{said}"):
        read_model(tmp_path / "mine.toml")


def test_layout_answers_by_name_and_names_the_nearest() -> None:
    skeleton = read_model("arm.R").skeleton
    assert skeleton.layout["elbow.R flexion"] == 6
    assert skeleton.layout.group("twist").tolist() == [5, 7]
    with pytest.raises(InputError, match="elbow.R flexion"):
        skeleton.layout["elbow.R flexon"]


def test_faulty_skeletons_are_refused() -> None:
    base = tuple(Dof(name=f"a {x}", axis=x) for x in "xyz")
    bone = Bone(name="one", parent=None, head_joint="a", tail_joint="b", nominal_length_m=1.0, R_rest=np.eye(3))
    loose = Bone(name="two", parent="one", head_joint="c", tail_joint="d", nominal_length_m=1.0, R_rest=np.eye(3))
    with pytest.raises(InputError, match="begin at a joint"):
        Skeleton(name="s", bones=(bone, loose), base_dofs=base)
    with pytest.raises(InputError, match="three base DOFs"):
        Skeleton(name="s", bones=(bone,), base_dofs=base[:2])
    with pytest.raises(InputError, match="no rotation"):
        Bone(name="bad", parent=None, head_joint="a", tail_joint="b", nominal_length_m=1.0, R_rest=2 * np.eye(3))
    with pytest.raises(InputError, match="rotation mode"):
        Bone(name="bad", parent=None, head_joint="a", tail_joint="b", nominal_length_m=1.0, R_rest=np.eye(3), rotation_mode="XXY")
