"""Corrections of a calibration that is a little wrong."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mitsuba_avatar.registration.camera_refinement import refine_cameras, unrefined
from mitsuba_avatar.registration.keypoints_3d import triangulate_person
from mitsuba_avatar.registration.settings import KeypointSettings
from tests.registration.people_in_cameras import make_cameras, seen, standing_person


def test_cameras_that_turned_agree_again_and_stay_near_the_calibration(one_thread):
    settings = KeypointSettings()
    true = make_cameras(1080, 1920)
    people = [standing_person((0.1 * index - 0.4, 0.07 * index - 0.3)) for index in range(10)]
    observations = np.stack([seen(true, person, noise=1.0, seed=index) for index, person in enumerate(people)])
    calibrated = dict(true)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.004, -0.006, 0.003]).as_matrix()
    calibrated["b"] = replace(true["b"], camera_from_world=turn @ true["b"].camera_from_world)
    before = triangulate_person(list(calibrated.values()), observations, "coco", settings)
    refined = refine_cameras(calibrated, before, turn=0.01, shift=0.03)
    corrected = refined.apply(calibrated)
    after = triangulate_person(list(corrected.values()), observations, "coco", settings)

    def error(cameras, person) -> float:
        points = person.positions[..., :3].reshape(-1, 3)
        pixels = [camera.project(points)[0] for camera in cameras.values()]
        return float(np.median(np.linalg.norm(np.stack(pixels) - observations.transpose(1, 0, 2, 3)[..., :2].reshape(4, -1, 2), axis=-1)))

    assert error(calibrated, before) > 3 * error(corrected, after) and error(corrected, after) < 2
    assert max(refined.turned.values()) < 0.02 and max(refined.shifted.values()) < 0.05
    assert max(refined.turned, key=refined.turned.get) == "b"


def test_no_correction_is_the_calibration():
    cameras = make_cameras()
    same = unrefined(cameras).apply(cameras)
    assert all(np.array_equal(same[name].camera_from_world, camera.camera_from_world) for name, camera in cameras.items())
