"""The viewing session without a browser: what each control does to the picture."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mitsuba_avatar.captures.cameras import look_at
from mitsuba_avatar.driving.signals import DrivingSignals
from mitsuba_avatar.viewing.painter import MOVING, STILL
from mitsuba_avatar.viewing.session import ViewerSession, encode_jpeg
from mitsuba_avatar.viewing.state import SURFACES
from mitsuba_avatar.viewing.window import camera_of_view
from tests.drawn_capture import TEST_FRAMES, TRAIN_FRAMES

WIDTH, HEIGHT = 60, 84


def camera(session: ViewerSession, side: float = 0.0):
    centre, target = session.first_view()
    offset = centre - target
    turned = np.array([offset[0] * np.cos(side) - offset[1] * np.sin(side), offset[0] * np.sin(side) + offset[1] * np.cos(side), offset[2]])
    return camera_of_view(look_at(target + turned, target), 0.6, WIDTH / HEIGHT, WIDTH, HEIGHT)


def picture(session: ViewerSession, **switches) -> np.ndarray:
    """The session's picture without map, as floats."""
    session.change(lambda state: replace(state, has_map=False, **switches))
    return session.picture(camera(session)).astype(float)


def difference(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.abs(first - second).mean())


def test_the_person_stands_in_the_first_view(session):
    image = picture(session)
    background = image[0, 0]
    covered = np.abs(image - background).max(axis=-1) > 12
    assert 0.08 < covered.mean() < 0.6 and covered[HEIGHT // 2, WIDTH // 2]
    assert not covered[0].any() and not covered[-1].any() and not covered[:, 0].any() and not covered[:, -1].any()


def test_every_surface_shows_something_else_of_the_same_outline(session):
    images = {surface: picture(session, surface=surface) for surface in SURFACES}
    outlines = {name: np.abs(image[20:] - image[0, 0]).max(axis=-1) > 3 for name, image in images.items()}
    for name, image in images.items():
        others = [difference(image[20:], other[20:]) for key, other in images.items() if key != name]
        assert min(others) > 0.5, name
        if name != "uncertainty":  # black where nothing is uncertain
            assert (outlines[name] != outlines["texture"]).mean() < 0.06, name


def test_switches_change_the_picture(session):
    plain = picture(session)
    assert difference(plain, picture(session, has_wireframe=True)) > 1
    assert difference(plain, picture(session, has_wireframe=False, has_shadow=False)) > 0.01
    np.testing.assert_array_equal(plain, picture(session, has_shadow=True))


def test_the_timeline_runs_along_the_test_split_and_begins_anew(session, drawn_capture):
    assert len(session.viewed.timeline) == TEST_FRAMES
    session.set_frame(TEST_FRAMES + 1)
    assert session.state.frame == 1
    np.testing.assert_array_equal(session.state.theta, drawn_capture.theta[TRAIN_FRAMES + 1])
    np.testing.assert_array_equal(session.state.root, drawn_capture.root[TRAIN_FRAMES + 1])


def test_in_place_keeps_the_first_root(session):
    session.set_frame(1)
    moved = picture(session)
    assert difference(moved, picture(session, is_in_place=True)) > 0.01
    session.change(lambda state: replace(state, root=session.viewed.timeline.root[0].numpy(), is_in_place=False))
    still = session.picture(camera(session))
    session.change(lambda state: replace(state, is_in_place=True))
    np.testing.assert_array_equal(session.picture(camera(session)), still)


def test_an_angle_turns_its_joint_and_counts_as_a_change(session):
    before, version = picture(session), session.version
    elbow = session.viewed.rig.dofs.names.index("elbow_flexion")
    low, high = session.angle_limits[elbow]
    session.change(lambda state: state.with_angle(elbow, float(high)))
    assert session.version == version + 1 and low <= 0 < high
    after = picture(session)
    assert difference(before, after) > 2


def test_limits_hold_every_recorded_pose(session):
    for signals in (session.viewed.training, session.viewed.timeline):
        theta = signals.theta.numpy()
        assert (theta >= session.angle_limits[:, 0]).all() and (theta <= session.angle_limits[:, 1]).all()


def test_face_and_latent_directions_move_the_picture_and_reset(session):
    plain = picture(session)
    session.change(lambda state: state.with_latent_shift(0, 3.0))
    shifted = picture(session)
    assert difference(plain, shifted) > 0.001
    session.change(lambda state: state.with_face_shift(0, 3.0))
    expected = session.state.face + 3 * session.face_directions.steps[0]
    np.testing.assert_allclose(session.face_signal(session.state), expected)
    session.reset_shifts()
    np.testing.assert_array_equal(picture(session), plain)


def test_every_imputation_gives_a_code_of_its_own(session):
    codes = {}
    for name in session.imputations:
        session.change(lambda state, name=name: replace(state, imputation=name))
        codes[name] = session.latent(session.state)
        assert codes[name].shape == (1, session.viewed.avatar.settings.latent_size)
        torch.testing.assert_close(session.latent(session.state), codes[name], msg="the same at every look")
    assert {"zero", "mean", "prior", "clip", "nearest", "temporal"} <= set(codes)
    assert not codes["zero"].any() and all(codes[name].any() for name in ("mean", "prior", "nearest"))
    torch.testing.assert_close(codes["mean"][0], session.viewed.latents.mu.mean(0))


def test_nearest_follows_the_pose_that_is_shown(session):
    """On a training pose, its own posterior mean; the timeline's frame does not matter."""
    session.change(lambda state: replace(state, imputation="nearest"))
    for row in (0, 5):
        session.load_pose("training", row)
        torch.testing.assert_close(session.latent(session.state)[0], session.viewed.latents.mu[row])


def test_a_click_on_the_map_loads_the_pose_under_it(session, drawn_capture):
    x, y = session.pose_map.points["test"][1]
    side = round(0.34 * WIDTH)
    place = ((x * side) / WIDTH, (HEIGHT - side + y * side) / HEIGHT)
    group, row = session.click(*place, WIDTH, HEIGHT)
    np.testing.assert_array_equal(session.state.theta, session.groups[group].theta[row])
    np.testing.assert_allclose(session.pose_map.place(session.state.theta), (x, y), atol=0.03)
    assert session.click(0.9, 0.1, WIDTH, HEIGHT) is None, "beside the map"
    session.change(lambda state: replace(state, has_map=False))
    assert session.click(*place, WIDTH, HEIGHT) is None, "without a map"


def test_the_map_stands_in_the_lower_left_corner(session):
    without = picture(session)
    session.change(lambda state: replace(state, has_map=True))
    with_map = session.picture(camera(session)).astype(float)
    side = round(0.34 * WIDTH)
    is_changed = np.abs(with_map - without).max(axis=-1) > 0
    assert is_changed[HEIGHT - side :, :side].mean() > 0.9
    is_changed[HEIGHT - side :, :side] = False
    assert not is_changed.any()


def test_a_moving_picture_is_coarser_but_the_same(session):
    session.change(lambda state: replace(state, has_map=False))
    coarse, fine = (session.picture(camera(session), quality).astype(float) for quality in (MOVING, STILL))
    assert 0 < difference(coarse, fine) < 6


def test_occlusion_lags_while_moving_and_is_right_when_still(session):
    session.change(lambda state: replace(state, has_map=False, surface="ambient occlusion"))
    session.picture(camera(session))
    elbow = session.viewed.rig.dofs.names.index("elbow_flexion")
    session.change(lambda state: state.with_angle(elbow, 2.0))
    session.picture(camera(session), MOVING)
    stale = session.painter._share[0]
    session.picture(camera(session))
    assert session.painter._share[0] != stale == np.asarray(session.viewed.timeline.theta[0]).tobytes()


def test_an_avatar_without_codes_of_training_frames_offers_what_needs_none(viewed, one_thread):
    bare = ViewerSession(replace(viewed, latents=None))
    assert bare.imputations == ("zero", "prior", "clip") and bare.latent_directions is None and bare.state.latent_shift == ()
    assert picture(bare).std() > 1


def test_named_facial_actions_stay_between_zero_and_one(viewed):
    session = ViewerSession(replace(viewed, face_names=("open", "blink", "frown")))
    session.change(lambda state: state.with_face_entry(1, 0.75).with_face_shift(0, 3.0))
    signal = session.face_signal(session.state)
    assert signal.min() >= 0 and signal.max() <= 1 and session.state.face[1] == 0.75


def test_one_frame_is_a_timeline_too(viewed):
    timeline = viewed.timeline.chosen([0])
    assert isinstance(timeline, DrivingSignals)
    session = ViewerSession(replace(viewed, timeline=timeline))
    session.set_frame(5)
    assert session.state.frame == 0


def test_measuring_plays_the_timeline_and_times_every_part(session):
    figures = session.measure(0.3, WIDTH, HEIGHT)
    assert figures["frames_per_second"] > 0.5
    assert {"occlusion_ms", "decoding_ms", "rendering_ms", "encoding_ms"} <= set(figures)
    parts = sum(value for name, value in figures.items() if name.endswith("_ms"))
    assert parts == pytest.approx(1000 / figures["frames_per_second"], rel=0.5)


def test_a_jpeg_is_one():
    assert encode_jpeg(np.zeros((8, 6, 3), np.uint8))[:2] == b"\xff\xd8"
