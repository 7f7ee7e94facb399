"""A map of poses: training and test poses as points of a plane, near where they are alike, to see coverage and to pick a pose by a click.

The plane is spanned by the two principal directions of the training poses' angles.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from mitsuba_avatar.driving.principal_directions import PrincipalDirections

MARGIN = 0.08  # of the map's side, around the points
REACH = 0.06  # of the map's side: a click farther from every point than this picks none
COLOURS = ((120, 170, 255), (255, 160, 70), (130, 220, 130), (230, 120, 220))  # of the groups in order
_BACKGROUND, _FRAME, _TEXT = (22, 24, 30), (90, 94, 104), (230, 230, 230)


class PoseMap:
    """Points of several groups of poses.

    Args:
        groups: name -> [N, D] pose angles in radians; the first one, the training poses, spans the plane.

    Raises:
        ValueError: if the first group has fewer than three poses.
    """

    def __init__(self, groups: Mapping[str, Float[np.ndarray, "_ D"]]):
        first = next(iter(groups.values()))
        if len(first) < 3:
            raise ValueError(f"PoseMap(): expected at least three training poses to span a plane; got {len(first)}. Leave the map out.")
        self.directions = PrincipalDirections.of(first, 2)
        flat = {name: self._flat(theta) for name, theta in groups.items()}
        points = np.concatenate(list(flat.values()))
        self._low, self._extent = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-6)
        self._low = self._low - 0.5 * (self._extent - np.ptp(points, axis=0))  # the shorter side stands in the middle
        self.points: dict[str, Float[np.ndarray, "_ 2"]] = {name: self._placed(values) for name, values in flat.items()}
        self._base: Image.Image | None = None

    def place(self, theta: Float[np.ndarray, "D"]) -> Float[np.ndarray, "2"]:  # noqa: F821
        """Where a pose lies on the map: x to the right and y downwards in 0..1, outside for poses far from all others."""
        return self._placed(self._flat(theta[None]))[0]

    def nearest(self, x: float, y: float) -> tuple[str, int] | None:
        """Group and row of the pose nearest to a point of the map; None where there is none near it."""
        best: tuple[float, str, int] | None = None
        for name, points in self.points.items():
            distance = np.hypot(points[:, 0] - x, points[:, 1] - y)
            row = int(distance.argmin()) if len(distance) else -1
            if row >= 0 and (best is None or distance[row] < best[0]):
                best = (float(distance[row]), name, row)
        return None if best is None or best[0] > REACH else best[1:]

    def draw(self, size: int, theta: Float[np.ndarray, "D"]) -> UInt8[np.ndarray, "S S 3"]:  # noqa: F821
        """The map as a picture of size x size pixels, with a ring around where a pose lies."""
        if self._base is None or self._base.width != size:
            self._base = self._drawn(size)
        picture = self._base.copy()
        x, y = np.clip(self.place(theta), 0, 1) * size
        radius = max(4, size // 40)
        ImageDraw.Draw(picture).ellipse((x - radius, y - radius, x + radius, y + radius), outline=(255, 255, 255), width=2)
        return np.array(picture)

    def _drawn(self, size: int) -> Image.Image:
        """The map without the ring."""
        picture = Image.new("RGB", (size, size), _BACKGROUND)
        draw, font = ImageDraw.Draw(picture), ImageFont.load_default(max(10, size // 15))
        radius = max(1.5, size / 90)
        for number, (name, points) in enumerate(self.points.items()):
            colour = COLOURS[number % len(COLOURS)]
            for x, y in points * size:
                draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
            draw.text((6, 4 + number * font.size * 1.2), name, fill=colour, font=font)
        draw.text((size - 6, size - 4), "click loads a pose", fill=_TEXT, font=font, anchor="rs")
        draw.rectangle((0, 0, size - 1, size - 1), outline=_FRAME)
        return picture

    def _flat(self, theta: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N 2"]:
        """Radians along both directions: distances on the map are those between poses, as far as a plane can keep them."""
        steps = self.directions.steps
        lengths = np.linalg.norm(steps, axis=1)
        flat = self.directions.coordinates(theta) * lengths
        return np.pad(flat, ((0, 0), (0, 2 - flat.shape[1])))

    def _placed(self, flat: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        placed = MARGIN + (1 - 2 * MARGIN) * (flat - self._low) / self._extent
        return np.stack([placed[:, 0], 1 - placed[:, 1]], axis=1)
