import numpy as np

from mitsuba_avatar.filming.face import conversation_face, expression_tour, gaze_of_actions, resting_face

NAMES = ("browInnerUp", "eyeBlinkLeft", "eyeBlinkRight", "jawOpen", "mouthSmileLeft", "mouthSmileRight")


def test_strengths_are_between_zero_and_one():
    time = np.arange(200) / 10
    for face in (resting_face, conversation_face, expression_tour):
        actions = face(time, NAMES, np.random.default_rng(0))
        assert actions.shape == (200, 6) and actions.min() >= 0 and actions.max() <= 1


def test_both_eyes_blink_together_and_mostly_stay_open():
    lids = resting_face(np.arange(300) / 10, NAMES, np.random.default_rng(1))[:, 1:3]
    np.testing.assert_array_equal(lids[:, 0], lids[:, 1])
    assert lids.max() > 0.7 and np.median(lids) < 1e-6


def test_talking_opens_the_jaw_again_and_again():
    jaw = conversation_face(np.arange(300) / 10, NAMES, np.random.default_rng(2))[:, 3]
    is_open = jaw > 0.15
    assert 10 < (np.diff(is_open.astype(int)) > 0).sum() < 120


def test_actions_that_a_rig_lacks_are_left_out():
    assert conversation_face(np.arange(20) / 10, ("unknown",), np.random.default_rng(0)).max() == 0


def test_gaze_follows_the_looks_of_both_eyes():
    names = ("eyeLookUpLeft", "eyeLookDownRight", "eyeLookOutLeft", "eyeLookInRight", "jawOpen")
    actions = np.array([[0.4, 0, 0, 0, 1.0], [0, 0.6, 0, 0, 0], [0, 0, 0.8, 0.8, 0]])
    gaze = gaze_of_actions(actions, names)
    np.testing.assert_allclose(gaze[0], [[0.2, 0], [0, 0]])
    np.testing.assert_allclose(gaze[1], [[0, 0], [-0.3, 0]])
    np.testing.assert_allclose(gaze[2], [[0, 0.4], [0, 0.4]])  # both to the person's left
