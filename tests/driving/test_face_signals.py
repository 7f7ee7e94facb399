"""Face signals of two kinds, and the way between them on the Anny rig."""

import numpy as np
import pytest

from mitsuba_avatar.body.anny_rig import build_anny_rig
from mitsuba_avatar.driving.face_signals import FaceKind, FaceModel, converted, reordered


@pytest.fixture(scope="module")
def anny():
    return build_anny_rig()


@pytest.fixture(scope="module")
def model(anny):
    return FaceModel.of_rig(anny)


def acted(model: FaceModel, count: int, seed: int = 0) -> np.ndarray:
    """[N, A] codes as people have them: few actions at a time, often none."""
    rng = np.random.default_rng(seed)
    codes = np.zeros((count, len(model.names)))
    for row in codes[count // 5 :]:
        row[rng.choice(len(row), 3, replace=False)] = rng.uniform(0.2, 1, 3)
    return codes


def test_codes_move_the_landmarks_that_their_action_moves(model):
    jaw = np.zeros((2, len(model.names)))
    jaw[1, model.names.index("jawOpen")] = 1.0
    moved = np.diff(model.landmarks(jaw), axis=0).reshape(-1, 3)
    lowest = int(np.abs(moved).sum(1).argmax())
    assert moved[lowest, 2] < -0.008, "the chin goes down by a centimetre"
    assert model.neutral.reshape(-1, 3)[lowest, 2] < model.neutral.reshape(-1, 3)[:, 2].mean()


def test_landmarks_tell_their_codes(model):
    codes = acted(model, 12)
    np.testing.assert_allclose(model.landmarks(model.codes(model.landmarks(codes))), model.landmarks(codes), atol=2e-4)


def test_a_persons_neutral_face_is_found_from_faces_that_move(model):
    """The person differs from the rig by millimetres that no action could make; most of that must be found."""
    rng = np.random.default_rng(3)
    offset = rng.normal(0, 1e-3, len(model.neutral))
    person = FaceModel(model.names, model.neutral + offset, model.displacements)
    found = model.of_person(person.landmarks(acted(model, 60)))
    assert np.abs(found.neutral - person.neutral).mean() < 0.5 * np.abs(offset).mean()


def test_action_codes_become_the_landmarks_that_the_avatar_wants(model, anny):
    codes = acted(model, 6)
    shuffled = np.random.default_rng(1).permutation(len(model.names))
    kind = FaceKind("action_codes", tuple(model.names[i].upper() for i in shuffled))
    made = converted(codes[:, shuffled], kind, FaceKind.of_rig(anny), model, anny)
    np.testing.assert_allclose(made, model.landmarks(codes), atol=1e-9)


def test_landmarks_become_codes_in_the_avatars_own_order(model, anny):
    wanted = FaceKind("action_codes", tuple(reversed(model.names)))
    codes = np.zeros((1, len(model.names)))
    codes[0, model.names.index("mouthPucker")] = 0.6
    made = converted(model.landmarks(codes), FaceKind.of_rig(anny), wanted, model, anny)
    assert made.shape == (1, 52) and made[0, wanted.names.index("mouthPucker")] == pytest.approx(0.6, abs=0.05)


def test_codes_that_are_missing_rest_at_zero():
    codes = reordered(np.array([[0.1, 0.2], [0.3, 0.4]]), ("JawOpen", "unknown"), ("cheekPuff", "jawOpen"))
    np.testing.assert_array_equal(codes, [[0, 0.1], [0, 0.3]])


def test_what_cannot_be_converted_says_why(model, anny, rig):
    landmarks = FaceKind("keypoints", tuple("abcdef"))
    with pytest.raises(ValueError, match="'small' has no facial actions that tie the two"):
        converted(np.zeros((1, 52)), FaceKind("action_codes", model.names), landmarks, None, rig)
    with pytest.raises(ValueError, match="expected 6 numbers of face landmarks a frame; got 9"):
        converted(np.zeros((1, 9)), landmarks, landmarks, None, rig)
    with pytest.raises(ValueError, match="Name the columns by ARKit's facial actions"):
        reordered(np.zeros((1, 2)), ("a", "b"), model.names)
    with pytest.raises(ValueError, match="expected the Anny rig, whose facial actions are known; got 'small'"):
        FaceModel.of_rig(rig)
