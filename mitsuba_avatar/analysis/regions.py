"""Which part of the surface a driving signal has any business with: the skin that it governs, and what lies near.

Localization confines a signal to cells of the texture atlas, and the decoder's receptive field carries it a few cells farther. In the
atlas the neighbours of a cell may belong to another part of the body: charts lie side by side that are far apart on the surface. Distance
is therefore measured on the body, not in the atlas, so that such leaks show.
"""

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from mitsuba_avatar.body.rig import Rig

NEAR = 0.1  # metres around the governed skin, at rest


def with_surroundings(rig: Rig, region: Bool[np.ndarray, "V"]) -> Bool[np.ndarray, "V"]:
    """A region of vertices and all that lies within `NEAR` of it in rest pose."""
    distance, _ = cKDTree(rig.rest_vertices[region]).query(rig.rest_vertices)
    return distance <= NEAR
