"""A camera with perspective, and where what it sees lies in its image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.evaluation.pictures.stage import FOV_DEG

Array = NDArray[np.float64]

_ELEVATION = math.radians(-13.0)
_DISTANCE = 1.9


@dataclass(frozen=True, kw_only=True)
class View:
    """A camera with perspective."""

    look: Array
    """Where it looks [m]. (3,)"""
    azimuth: float
    """Of its view, in the world [rad]."""
    elevation: float = _ELEVATION
    """Of its view, negative down [rad]."""
    distance: float = _DISTANCE
    """From where it looks [m]."""

    def pixels(self, points: Array, width: int, height: int) -> Array:
        """Where points of the world are in an image.

        Args:
            points: [m]. (N, 3)
            width: Of the image [px].
            height: Of the image [px].

        Returns:
            Right and down of the upper left corner [px]; NaN for points behind the camera. (N, 2)
        """
        cosine = math.cos(self.elevation)
        ahead = np.array(
            [
                math.cos(self.azimuth) * cosine,
                math.sin(self.azimuth) * cosine,
                math.sin(self.elevation),
            ]
        )
        right = np.array([math.sin(self.azimuth), -math.cos(self.azimuth), 0.0])
        up = np.cross(right, ahead)
        relative = np.asarray(points) - (self.look - self.distance * ahead)
        depth = relative @ ahead
        depth = np.where(depth > 1e-6, depth, np.nan)
        focal = 0.5 * height / math.tan(math.radians(0.5 * FOV_DEG))
        x = 0.5 * width + focal * (relative @ right) / depth
        y = 0.5 * height - focal * (relative @ up) / depth
        return np.stack([x, y], axis=-1)
