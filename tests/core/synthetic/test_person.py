"""The synthetic whole person: wholly in every picture, closed parts that follow the bones, and a surface that no metaballs make."""

from pathlib import Path

import numpy as np
import pytest

from tricap.core.body.skeleton import joint_positions
from tricap.core.geometry.rig import read_rig
from tricap.core.synthetic.arm import ArmTakeSettings, make_arm_take
from tricap.core.synthetic.figure import Part, joined
from tricap.core.synthetic.person import ARM, BLEND, JOINTS, RAYS, RINGS, chain_weights, person
from tricap.core.synthetic.subject import Subject
from tricap.core.synthetic.truth import closest_on_mesh, motion_capture_name, read_truth
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take

SWING_S, SECONDS = 1.36, 0.64  # of the sample's 16 frames


@pytest.fixture(scope="module")
def subject() -> Subject:
    return person(SWING_S)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("person") / "take"
    make_arm_take(folder, ArmTakeSettings(subject="person", frames=2, width_px=192, interlaced="none"))
    return folder


def test_it_is_a_take_of_a_whole_body_with_truth(take: Path) -> None:
    footage, truth = open_take(read_take(take)), read_truth(take)
    assert footage.take.body_model == "full" and set(footage.take.clicks.joints) == set(JOINTS)
    assert set(truth.joints_m) == {motion_capture_name(name) for name in JOINTS} and truth.radii_m is None and truth.lengths_m is not None
    assert 0.15 < truth.visible.mean() < 0.6


def test_all_of_the_person_is_in_every_picture(take: Path, subject: Subject) -> None:
    rig = read_rig(take / "rig.toml")
    for time_s in np.linspace(0, SECONDS, 5):
        scene = joined(subject.parts(float(time_s)))
        assert all(camera.sees(camera.project(scene.vertices_m)).all() for camera in rig.cameras)


def volume(part: Part) -> float:
    """Positive for a closed mesh that faces outwards."""
    a, b, c = (part.vertices_m[part.triangles[:, k]] for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


def test_parts_are_closed_and_keep_their_volume(subject: Subject) -> None:
    now, later = subject.parts(0.0), subject.parts(0.34)
    for a, b in zip(now, later):
        edges = np.sort(a.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
        assert volume(a) > 0 and volume(b) == pytest.approx(volume(a), rel=0.12)  # linear skinning loses some at bent joints


def test_joints_are_inside(subject: Subject) -> None:
    """Every joint is at most as far from the surface as the thickest limb there, and moves with it."""
    for time_s in (0.0, 0.5):
        scene = joined(subject.parts(time_s))
        places = joint_positions(subject.shape.skeleton, subject.shape.lengths_m, subject.motion(time_s))
        for name in JOINTS:
            distance = closest_on_mesh(scene.vertices_m, scene.triangles, places[name][None])[0][0]
            assert distance < 0.14, name
            nearest = scene.vertices_m[np.linalg.norm(scene.vertices_m - places[name], axis=1).argmin()]
            assert np.linalg.norm(nearest - places[name]) < 0.15, name


def test_sections_are_no_ellipses(subject: Subject) -> None:
    """A metaball's sections are ellipses; these bulge out beyond the ellipse of the same half axes."""
    ring = subject.parts(0.0)[0].rest_m[1 + RINGS // 2 * RAYS :][:RAYS]
    x, y = ring[:, 0], ring[:, 1] - ring[:, 1].mean()
    a, b = np.ptp(x) / 2, np.ptp(y) / 2
    assert np.sqrt((x / a) ** 2 + (y / b) ** 2).max() > 1.06


def test_weights_pass_from_bone_to_bone() -> None:
    lengths = np.array([0.3, 0.25])
    s = np.linspace(-0.1, 0.6, 200)
    weights = chain_weights(s, lengths)
    assert np.allclose(weights.sum(axis=1), 1) and (weights >= 0).all() and len(ARM.bones) == weights.shape[1]
    mixed = (weights > 0).all(axis=1)
    assert np.allclose([s[mixed].min(), s[mixed].max()], [0.3 - BLEND * 0.25, 0.3 + BLEND * 0.25], atol=0.008)


def test_steps_take_as_long_as_asked(subject: Subject) -> None:
    names = subject.shape.skeleton.dof_names
    hip = subject.motion(np.array([0.0, SWING_S / 4, SWING_S]))[:, names.index("hip.R flexion")]
    assert hip[2] == pytest.approx(hip[0]) and hip[1] - hip[0] > np.radians(20)
