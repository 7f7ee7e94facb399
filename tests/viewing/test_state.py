"""The state: changes make a new one and leave the old one alone; angles find their limbs."""

import numpy as np

from mitsuba_avatar.viewing.state import OTHERS, ViewState, limb_groups


def test_changes_leave_the_old_state_alone():
    state = ViewState(np.zeros(3), np.eye(4), np.zeros(2), face_shift=(0.0, 0.0), latent_shift=(0.0,))
    changed = state.with_angle(1, 0.5).with_face_entry(0, 0.25).with_face_shift(1, -2.0).with_latent_shift(0, 1.5)
    assert changed.theta.tolist() == [0, 0.5, 0] and changed.face.tolist() == [0.25, 0]
    assert changed.face_shift == (0.0, -2.0) and changed.latent_shift == (1.5,)
    assert not state.theta.any() and not state.face.any() and state.face_shift == (0.0, 0.0)


def test_angles_are_grouped_by_limb():
    names = ("spine05_bend", "base_twist", "head_turn", "left_elbow_flexion", "left_index_tip_flexion", "right_big_toe_flexion")
    names += ("left_eye_elevation", "right_eye_elevation")
    assert limb_groups(names) == {
        "trunk": [0],
        "neck and head": [2],
        "left arm": [3],
        "left hand": [4],
        "right leg": [5],
        "eyes": [6, 7],
        OTHERS: [1],
    }
