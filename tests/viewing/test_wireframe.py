"""Edges over a picture: where they project to, and only those that are seen."""

import numpy as np

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.viewing.wireframe import INK, draw_wireframe

CAMERA = Camera("c", 40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4))
SQUARE = np.array([[-0.2, -0.1, 1.0], [0.2, -0.1, 1.0], [0.2, 0.1, 1.0], [-0.2, 0.1, 1.0]])
TOWARDS_CAMERA = np.array([[0, 2, 1], [0, 3, 2]])


def drawn(vertices: np.ndarray, faces: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[30, 40] True where a line runs."""
    image = np.full((30, 40, 3), 200, np.uint8)
    result = draw_wireframe(image, depth, vertices, faces, CAMERA)
    assert (image == 200).all(), "the given picture stays"
    assert set(np.unique(result)) <= {200, int(200 * INK)}
    return (result < 200).all(axis=-1)


def test_lines_run_along_the_projected_edges():
    lines = drawn(SQUARE, TOWARDS_CAMERA, np.ones((30, 40)))
    assert lines[10, 10:30].mean() > 0.6 and lines[20, 10:30].mean() > 0.6, "upper and lower edge"
    assert not lines[:9].any() and not lines[22:].any() and not lines[:, :9].any() and not lines[12, 20:28].any()


def test_hidden_and_averted_faces_have_no_lines():
    assert not drawn(SQUARE, TOWARDS_CAMERA[:, ::-1], np.ones((30, 40))).any(), "turned away"
    depth = np.ones((30, 40))
    depth[:, :20] = 0.5  # something stands before the left half
    lines = drawn(SQUARE, TOWARDS_CAMERA, depth)
    assert not lines[:, :20].any() and lines[:, 20:].any()
    depth[:] = 0
    assert not drawn(SQUARE, TOWARDS_CAMERA, depth).any(), "nothing is seen at all"
    behind = SQUARE - [0, 0, 3]
    assert not drawn(behind, TOWARDS_CAMERA[:, ::-1], np.ones((30, 40))).any(), "behind the camera"
