"""2D keypoints of detectors, read into one order of our own.

`LANDMARKS` names every point that some detector finds; a detector's order is a list of those names, and what it does not find is NaN.
Files are OpenPose's JSON (`people`, each with `pose_keypoints_2d`: x, y, confidence), which AlphaPose, MMPose and Pose2Sim write too.

Symbols: K landmarks, P people.
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

LIMB_LANDMARKS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
FOOT_LANDMARKS = ("big_toe", "small_toe", "heel")


def _both(name: str) -> tuple[str, str]:
    return f"left_{name}", f"right_{name}"


LANDMARKS = (
    "nose",
    *(side for name in ("eye", "ear", *LIMB_LANDMARKS) for side in _both(name)),
    *("neck", "mid_hip", "upper_neck", "head_top"),
    *(side for name in FOOT_LANDMARKS for side in _both(name)),
)

_COCO = ("nose", *(side for name in ("eye", "ear", *LIMB_LANDMARKS) for side in _both(name)))
_ARMS = tuple(f"{side}_{name}" for side in ("right", "left") for name in ("shoulder", "elbow", "wrist"))
_LEGS = tuple(f"{side}_{name}" for side in ("right", "left") for name in ("hip", "knee", "ankle"))
_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")

ORDERS: dict[str, tuple[str, ...]] = {
    "body_25": (
        *("nose", "neck", *_ARMS, "mid_hip", *_LEGS, *_FACE),
        *("left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel"),
    ),
    "body_25b": (
        *(*_COCO, "upper_neck", "head_top"),
        *("left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel"),
    ),
    "coco": _COCO,
    "openpose_coco": ("nose", "neck", *_ARMS, *_LEGS, *_FACE),
    "halpe_26": (
        *(*_COCO, "head_top", "neck", "mid_hip"),
        *("left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel", "right_heel"),
    ),
}
HALPE_BODY = 26  # the first points of HALPE's 136; the rest are face and hands


def read_people(path: Path | str, least_confidence: float = 0.0) -> Float64[np.ndarray, "P points 3"]:
    """Everybody in one frame of one camera, in the detector's order.

    Args:
        path: OpenPose JSON.
        least_confidence: points below it become NaN, as points that were not found (confidence 0) always do.

    Returns:
        [P, points, 3] x, y in pixels with the origin at the image's corner (files count from the first pixel's centre), confidence.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for text that is not JSON, another schema, or people with different numbers of points; names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"read_people(): expected keypoints at {path}; got none. Detect them first.")
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        flat = [np.asarray(person["pose_keypoints_2d"], dtype=np.float64) for person in document["people"]]
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"read_people(): expected OpenPose JSON, {{'people': [{{'pose_keypoints_2d': [x, y, confidence, ...]}}]}}, in {path}; got "
            f"{type(error).__name__}: {error}. Write the keypoints in that schema."
        ) from error
    lengths = {len(values) for values in flat}
    if not flat:
        return np.zeros((0, 0, 3))
    if len(lengths) > 1 or lengths.pop() % 3 or flat[0].ndim != 1:
        raise ValueError(
            f"read_people(): expected x, y, confidence of as many points for everybody in {path}; got {[len(values) for values in flat]} "
            "numbers. Detect again."
        )
    people = np.stack(flat).reshape(len(flat), -1, 3)
    people[..., :2] += 0.5
    people[~(people[..., 2] > least_confidence)] = np.nan
    return people


def orders_of_length(num_points: int) -> list[str]:
    """Names of the orders that have so many points.

    Raises:
        ValueError: if none has.
    """
    num_points = HALPE_BODY if num_points == 136 else num_points
    names = [name for name, order in ORDERS.items() if len(order) == num_points]
    if not names:
        known = {name: len(order) for name, order in ORDERS.items()}
        raise ValueError(f"orders_of_length(): expected keypoints of a known order, {known} points; got {num_points}. Convert them.")
    return names


def in_landmark_order(people: Float64[np.ndarray, "P points 3"], order: str) -> Float64[np.ndarray, "P K 3"]:
    """Points of a detector's order as [P, K, 3] in the order of `LANDMARKS`, NaN where the detector has none.

    Raises:
        ValueError: if the order has more points than were given.
    """
    names = ORDERS[order]
    if len(people) and people.shape[1] < len(names):
        raise ValueError(
            f"in_landmark_order(): expected {len(names)} points of {order}; got {people.shape[1]}. "
            f"Set keypoints.order to one of {orders_of_length(people.shape[1])}."
        )
    result = np.full((len(people), len(LANDMARKS), 3), np.nan)
    if len(people):
        result[:, [LANDMARKS.index(name) for name in names]] = people[:, : len(names)]
    return result
