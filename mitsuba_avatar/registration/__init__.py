"""From calibrated videos of a real person to a capture: keypoints, silhouettes, the body fitted to both."""
