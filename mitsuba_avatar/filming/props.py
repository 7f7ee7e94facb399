"""Small things on the stage that follow the body: parts of its own surface with a finer atlas, and rigid things worn on it.

Each knows its layer and where its surface lies when the body's does; neither moves by itself. Metres; posed surfaces in world axes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int
from scipy.spatial.transform import Rotation

from mitsuba_avatar.filming.stage import Layer


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class BodyPart:
    """Faces of the body that are filmed with paint of their own; leave them out of the body's layer.

    Attributes:
        layer: what is seen.
        faces: [F] the body's faces that it replaces.
        body_vertices: [P] the body's vertex of each of the layer's.
    """

    layer: Layer
    faces: Bool[np.ndarray, "F"]
    body_vertices: Int[np.ndarray, "P"]

    def surface(self, body: Float32[np.ndarray, "V 3"]) -> Float32[np.ndarray, "P 3"]:
        """[P, 3] its vertices, of a posed body [V, 3]."""
        return body[self.body_vertices]


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class RigidProp:
    """A thing that keeps its shape and follows some vertices of the body.

    Attributes:
        layer: what is seen.
        rest_vertices: [P, 3] where it lies on the resting body.
        anchors: [A] the body's vertices that it follows, not all on one line.
        rest_anchors: [A, 3] where these rest.
    """

    layer: Layer
    rest_vertices: Float32[np.ndarray, "P 3"]
    anchors: Int[np.ndarray, "A"]
    rest_anchors: Float32[np.ndarray, "A 3"]

    def surface(self, body: Float32[np.ndarray, "V 3"]) -> Float32[np.ndarray, "P 3"]:
        """[P, 3] its vertices, of a posed body [V, 3]: moved as the anchors are, by the nearest rigid motion."""
        posed_anchors = body[self.anchors].astype(np.float64)
        rest_centre, posed_centre = self.rest_anchors.mean(axis=0), posed_anchors.mean(axis=0)
        rotation = Rotation.align_vectors(posed_anchors - posed_centre, self.rest_anchors - rest_centre)[0]
        return (rotation.apply(self.rest_vertices - rest_centre) + posed_centre).astype(np.float32)
