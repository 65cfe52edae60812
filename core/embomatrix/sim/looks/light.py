"""Soft light from many directions: a depth map for each, with the mean and spread of its depths (variance shadow maps).

A point is lit as far as the depths around it on the map lie below its own: Donnelly and Lauritzen, Variance Shadow Maps, 2006.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from embomatrix.sim.looks.view import FloatArray, View
from embomatrix.world.geometry import Aabb

DepthArray = NDArray[np.float32]

FAR_AWAY: Final = 20.0
"""Distance of a light in radii of the lit sphere: its rays are nearly parallel."""
_BLUR_TEXELS: Final = 5
_LEAST_SPREAD_M: Final = 0.008
_BLEED: Final = 0.25
"""Lower shares of light count as shadow: they come from the spread at the edges of distant objects."""


@dataclass(frozen=True, slots=True)
class Lamp:
    """Direction to a light, azimuth and tilt from the zenith in degrees, and its share of all light."""

    azimuth: float
    tilt: float
    share: float

    @property
    def direction(self) -> NDArray[np.float64]:
        azimuth, tilt = math.radians(self.azimuth), math.radians(self.tilt)
        return np.array(
            [math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)]
        )


LAMPS: Final = (
    Lamp(-35.0, 22.0, 0.40),
    Lamp(75.0, 38.0, 0.09),
    Lamp(165.0, 38.0, 0.09),
    Lamp(285.0, 38.0, 0.09),
    Lamp(30.0, 60.0, 0.11),
    Lamp(150.0, 60.0, 0.11),
    Lamp(270.0, 60.0, 0.11),
)
"""A key light and a dome around it. Ceilings cast no shadow, so that rooms are lit from above."""


@dataclass(frozen=True)
class ShadowMap:
    """Depths seen from one light: their mean and the mean of their squares around each texel."""

    lamp: Lamp
    view: View
    mean: DepthArray
    square: DepthArray

    def light_at(self, points: FloatArray, slope: FloatArray) -> FloatArray:
        """Return the share of the light that reaches points, shape (n,).

        ``slope`` is the cosine of the angle between the light and the surface's normal.
        """
        side = self.mean.shape[0]
        x, y, ahead = self.view.axes.astype(np.float32) @ (points - self.view.eye_m.astype(np.float32)).T
        scale = np.float32(side / 2 / self.view.tangent) / ahead
        column = (x * scale + np.float32(side / 2)).astype(np.int32)
        row = (np.float32(side / 2) - y * scale).astype(np.int32)
        outside = (column < 0) | (column >= side) | (row < 0) | (row >= side)
        at = np.clip(row, 0, side - 1) * side + np.clip(column, 0, side - 1)
        mean, square = self.mean.reshape(-1)[at], self.square.reshape(-1)[at]
        texel_m = np.float32(2 * self.view.tangent / side) * ahead
        # A sloped surface spans a range of depths within one texel.
        ease = texel_m * (0.5 + 1.5 * np.sqrt(1 - slope * slope) / np.maximum(slope, 0.2))
        behind = ahead - np.float32(self._middle) - mean - ease
        spread = np.maximum(square - mean * mean, np.float32(_LEAST_SPREAD_M**2))
        lit = spread / (spread + np.maximum(behind, 0) ** 2)
        lit = np.clip((lit - np.float32(_BLEED)) / np.float32(1 - _BLEED), 0, 1)
        lit[outside | (behind <= 0)] = 1.0
        return np.asarray(lit, np.float32)

    @property
    def _middle(self) -> float:
        """Distance of the middle of the lit sphere; depths of a map count from there."""
        return (self.view.near_m + self.view.far_m) / 2


def shadow_maps(
    region: Aabb, side_px: int, depth_from: Callable[[View, int], DepthArray]
) -> tuple[ShadowMap, ...]:
    """Return the maps of all lamps for a region. ``depth_from`` renders square depth maps of a side in pixels."""
    middle = np.asarray(region.center_m)
    radius = float(np.linalg.norm(region.size_m)) / 2
    angle = 2 * math.degrees(math.atan(1.02 / FAR_AWAY))
    maps = []
    for lamp in LAMPS:
        eye = middle + lamp.direction * FAR_AWAY * radius
        near, far = (FAR_AWAY - 1.02) * radius, (FAR_AWAY + 1.02) * radius
        view = View.toward(eye.tolist(), middle.tolist(), angle, 1.0, near, far)
        depth = view.distances(depth_from(view, side_px)) - np.float32((near + far) / 2)
        mean = uniform_filter(depth, _BLUR_TEXELS, mode="nearest")
        square = uniform_filter(depth * depth, _BLUR_TEXELS, mode="nearest")
        maps.append(ShadowMap(lamp, view, mean, square))
    return tuple(maps)
