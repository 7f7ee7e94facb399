"""Reading what drives: captures, arrays, BVH, Live Link Face, action codes."""

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.anny_rig import build_anny_rig, facial_action_displacements
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices
from mitsuba_avatar.driving.face_signals import FaceKind
from mitsuba_avatar.driving.sources import load_body, load_face
from tests.recordings.written import bvh_text, movement

THREE = FaceKind("keypoints", ("a", "b", "c"))


def save(path, values) -> None:
    np.save(path, np.asarray(values, np.float32))


def test_a_capture_gives_the_frames_of_its_split(drawn_capture, rig):
    test, everything = (load_body(drawn_capture.path, rig, split=split) for split in ("test", "all"))
    np.testing.assert_array_equal(test.theta, drawn_capture.theta[8:])
    assert test.frames == (8, 9) and test.fps == 10.0 and everything.clips == (slice(0, 8), slice(8, 10))
    cut = load_body(drawn_capture.path, rig, split="all", seconds=0.9)
    assert len(cut.theta) == len(cut.frames) == 9 and cut.clips == (slice(0, 8), slice(8, 9))
    face = load_face(drawn_capture.path, THREE, 10.0, "test")
    np.testing.assert_array_equal(face.values.astype(np.float32), drawn_capture.face[8:])
    assert face.kind.signal == "keypoints"


def test_a_folder_of_arrays_and_a_file_alone(tmp_path, rig):
    theta, root = np.random.default_rng(0).normal(0, 0.2, (4, 5)), np.tile(np.eye(4), (4, 1, 1))
    root[:, 2, 3] = [0, 1, 2, 3]
    save(tmp_path / "theta.npy", theta)
    alone = load_body(tmp_path / "theta.npy", rig)
    assert alone.fps == 10.0 and "the root stays" in alone.notes[0] and not alone.root[3, 2, 3]
    save(tmp_path / "root.npy", root)
    for path in (tmp_path, tmp_path / "theta.npy"):
        track = load_body(path, rig, fps=25.0)
        np.testing.assert_allclose(track.theta, theta, atol=1e-7)
        assert track.fps == 25.0 and track.root[3, 2, 3] == 3 and track.notes == ()


def test_a_bvh_person_stands_on_the_floor(tmp_path):
    anny = build_anny_rig()
    (tmp_path / "sway.bvh").write_text(bvh_text(*movement()), encoding="utf-8")
    track = load_body(tmp_path / "sway.bvh", anny, fps=5.0)
    assert track.theta.shape == (5, len(anny.dofs.names)) and track.fps == 5.0 and track.clips == (slice(0, 5),)
    assert any("degrees from the recording" in note for note in track.notes)
    with torch.no_grad():
        transforms = Skeleton(anny)(torch.from_numpy(track.theta), torch.from_numpy(track.root))
        rest = torch.from_numpy(anny.rest_vertices).expand(5, -1, -1)
        lowest = pose_vertices(rest, transforms, torch.from_numpy(anny.skinning_weights))[..., 2].amin(1)
    assert lowest.abs().max() < 1e-4
    assert len(load_body(tmp_path / "sway.bvh", anny, seconds=0.5).theta) == 15, "30 frames a second unless asked"


def test_a_face_from_live_link_keeps_its_times(tmp_path):
    rows = "\n".join(f"00:00:0{second}:00,61,{second / 4},0" for second in range(1, 4))
    (tmp_path / "take.csv").write_text(f"Timecode,BlendshapeCount,JawOpen,HeadYaw\n{rows}\n")
    face = load_face(tmp_path / "take.csv", THREE, 30.0)
    assert face.kind == FaceKind("action_codes", ("jawOpen",))
    np.testing.assert_allclose(face.recording.at(np.array([0.0, 0.5, 2.0]))[:, 0], [0.25, 0.375, 0.75])


def test_a_table_of_codes_is_read_by_its_header(tmp_path):
    (tmp_path / "stream.csv").write_text("time,EYEBLINKLEFT,jawOpen\n0,0.5,0.25\n1,2,0\n")
    face = load_face(tmp_path / "stream.csv", THREE, 10.0)
    assert face.kind.names == ("eyeBlinkLeft", "jawOpen")
    np.testing.assert_allclose(face.values, [[0.5, 0.25], [1.0, 0.0]])
    np.testing.assert_allclose(face.recording.times, [0, 0.1])


def test_an_array_is_known_by_its_columns(tmp_path):
    save(tmp_path / "face.npy", np.zeros((2, 3)))
    assert load_face(tmp_path / "face.npy", THREE, 10.0).kind == THREE
    save(tmp_path / "codes.npy", np.zeros((2, 52)))
    assert load_face(tmp_path / "codes.npy", THREE, 10.0).kind.names == facial_action_displacements()[0]


@pytest.mark.parametrize(
    ("write", "name", "message"),
    [
        (None, "gone.bvh", "there is none"),
        (None, "gone.npy", "there is no such file"),
        (None, "gone", "there is none. Check the path"),
        (lambda path: path.write_text("x"), "motion.fbx", "expected a capture, .bvh or .npy; got"),
        (lambda path: path.mkdir(), "empty", "expected capture.yaml, theta.npy or pose.npy in"),
        (lambda path: save(path, np.zeros((3, 7))), "theta.npy", "expected 5 pose angles a frame, those of the rig 'small'"),
        (lambda path: save(path, np.full((3, 5), np.nan)), "theta.npy", "expected finite numbers with 2 axes"),
        (lambda path: path.write_bytes(b"cut"), "theta.npy", "expected a plain array in"),
        (lambda path: path.write_text(bvh_text(*movement())), "sway.bvh", "expected an avatar on the Anny rig"),
    ],
)
def test_motion_that_cannot_drive_is_refused(tmp_path, rig, write, name, message):
    if write is not None:
        write(tmp_path / name)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_body(tmp_path / name, rig)


@pytest.mark.parametrize(
    ("write", "name", "message"),
    [
        (None, "gone.csv", "there is none"),
        (lambda path: path.write_text("a,b\n1,2\n"), "codes.csv", "expected a header of ARKit's facial actions"),
        (lambda path: path.write_text("jawOpen\nwide\n"), "codes.csv", "expected numbers in every row"),
        (lambda path: save(path, np.zeros((2, 7))), "face.npy", r"expected 3 columns \(keypoints, as the avatar was trained\) or 52"),
        (lambda path: path.write_text("x"), "face.wav", "expected a capture, .npy or .csv; got"),
    ],
)
def test_faces_that_cannot_drive_are_refused(tmp_path, write, name, message):
    if write is not None:
        write(tmp_path / name)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_face(tmp_path / name, THREE, 10.0)


def test_a_capture_of_another_rig_is_refused_by_the_names_of_its_angles(drawn_capture):
    with pytest.raises(ValueError, match="expected the pose angles of the avatar's rig 'anny' in .*; got others: "):
        load_body(drawn_capture.path, build_anny_rig())


def test_no_time_at_all_is_refused(drawn_capture, rig):
    with pytest.raises(ValueError, match="expected at least one frame in 0.01 s"):
        load_body(drawn_capture.path, rig, seconds=0.01)
