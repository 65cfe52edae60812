"""Perspective views of a renderer: pixels with their depth become points, and points become pixels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from embomatrix.world.geometry import FloatArray as DoubleArray

FloatArray = NDArray[np.float32]
IntArray = NDArray[np.signedinteger[Any]]


@dataclass(frozen=True)
class View:
    """Pinhole camera. ``axes`` are its right, up and ahead, rows of shape (3, 3) in the world frame.

    ``tangent`` is that of half the vertical field of view. Depth values lie between ``near_m`` and ``far_m``.
    """

    eye_m: DoubleArray
    axes: DoubleArray
    tangent: float
    aspect: float
    near_m: float
    far_m: float

    @staticmethod
    def toward(
        eye_m: Sequence[float],
        target_m: Sequence[float],
        field_of_view_deg: float,
        aspect: float,
        near_m: float,
        far_m: float,
    ) -> "View":
        """Return the view from one point to another, with z up (y for a camera that looks straight down)."""
        eye, ahead = np.asarray(eye_m, float), np.subtract(target_m, eye_m)
        ahead = ahead / np.linalg.norm(ahead)
        upright = (0.0, 1.0, 0.0) if abs(ahead[2]) > 0.999 else (0.0, 0.0, 1.0)
        right = np.cross(ahead, upright)
        right /= np.linalg.norm(right)
        axes = np.array([right, np.cross(right, ahead), ahead])
        return View(eye, axes, math.tan(math.radians(field_of_view_deg) / 2), aspect, near_m, far_m)

    @property
    def view_matrix(self) -> list[float]:
        """Matrix of 16 numbers from the world to the camera's frame, column by column, as OpenGL has it."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.axes * np.array([[1.0], [1.0], [-1.0]])
        matrix[:3, 3] = -matrix[:3, :3] @ self.eye_m
        return [float(value) for value in matrix.T.reshape(-1)]

    @property
    def lens_matrix(self) -> list[float]:
        """Projection matrix of 16 numbers, column by column."""
        span = self.near_m - self.far_m
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 1] = 1 / (self.tangent * self.aspect), 1 / self.tangent
        matrix[2, 2], matrix[2, 3] = (self.far_m + self.near_m) / span, 2 * self.far_m * self.near_m / span
        matrix[3, 2] = -1.0
        return [float(value) for value in matrix.T.reshape(-1)]

    def distances(self, depth: FloatArray) -> FloatArray:
        """Return distances along the camera's axis from depth values of a renderer."""
        near, far = np.float32(self.near_m), np.float32(self.far_m)
        return np.asarray(far * near / (far - (far - near) * depth), np.float32)

    def rays(self, rows: IntArray, columns: IntArray, width_px: int, height_px: int) -> FloatArray:
        """Return directions through the middles of pixels, shape (n, 3), of length 1 along the camera's axis."""
        x = ((np.arange(width_px) + 0.5) * (2 / width_px) - 1) * (self.tangent * self.aspect)
        y = (1 - (np.arange(height_px) + 0.5) * (2 / height_px)) * self.tangent
        right, up, ahead = self.axes
        across = (x[:, None] * right + ahead).astype(np.float32)  # (width, 3)
        along = (y[:, None] * up).astype(np.float32)  # (height, 3)
        return np.asarray(across[columns] + along[rows], np.float32)

    def project(self, points: DoubleArray, width_px: int, height_px: int) -> DoubleArray:
        """Return columns, rows and distances of points, shape (n, 3)."""
        x, y, ahead = self.axes @ (points - self.eye_m).T
        column = (x / (ahead * self.tangent * self.aspect) + 1) / 2 * width_px
        row = (1 - y / (ahead * self.tangent)) / 2 * height_px
        return np.stack([column, row, ahead], axis=-1)
