"""Contact sheet of assets: one picture for each, and a second one with doors and drawers open."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from embomatrix.factory.assets.shapes import mesh_of
from embomatrix.factory.pictures.sheet import in_rows
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, FloatArray

TILE_PX: Final = 190
_COLUMNS: Final = 8
_TEXT_PX: Final = 24
_AZIMUTH: Final = math.radians(35.0)
_ELEVATION: Final = math.radians(28.0)
_BASE: Final = np.array((205.0, 190.0, 165.0))
_MOVING: Final = np.array((120.0, 165.0, 215.0))
_LIGHT: Final = np.array((0.62, 0.30, 0.72))
OPEN_SHARE: Final = 0.6
"""Share of their travel by which doors and drawers are open in the second picture."""


def draw_sheet(assets: Sequence[Asset], columns: int = _COLUMNS) -> Image.Image:
    """Return an RGB image with one tile for each asset, and a second tile for each asset with doors or drawers."""
    tiles = [(asset, 0.0) for asset in assets]
    tiles += [(asset, OPEN_SHARE) for asset in assets if asset.joints]
    tiles.sort(key=lambda tile: tile[0].asset_id)
    named = [
        (_draw_asset(asset, share), f"{asset.category[:30]}\n{_metres(asset)}") for asset, share in tiles
    ]
    return in_rows(named, columns, caption_px=_TEXT_PX)


def _metres(asset: Asset) -> str:
    return " x ".join(f"{extent:.2f}" for extent in asset.size_m)


def _draw_asset(asset: Asset, share: float) -> Image.Image:
    """Draw faces from back to front: parts are convex and do not interlock, so this order is nearly right."""
    tile = Image.new("RGB", (TILE_PX, TILE_PX), "white")
    draw = ImageDraw.Draw(tile)
    faces, colors = _faces(asset, share)
    right, up, toward = _camera()
    flat = np.stack((faces @ right, faces @ up), axis=-1)  # (n, 3, 2)
    low, high = flat.reshape(-1, 2).min(axis=0), flat.reshape(-1, 2).max(axis=0)
    scale = (TILE_PX - 16) / max(float((high - low).max()), 1e-6)
    middle = (low + high) / 2
    for k in np.argsort((faces @ toward).mean(axis=1)):
        points = (flat[k] - middle) * scale
        polygon = [(TILE_PX / 2 + x, TILE_PX / 2 - y) for x, y in points.tolist()]
        draw.polygon(polygon, fill=tuple(colors[k]))
    return tile


def _camera() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the picture's right and up axes and the direction to the camera, which sees the front and left sides."""
    cos_a, sin_a = math.cos(_AZIMUTH), math.sin(_AZIMUTH)
    cos_e, sin_e = math.cos(_ELEVATION), math.sin(_ELEVATION)
    toward = np.array((cos_e * cos_a, cos_e * sin_a, sin_e))
    right = np.array((-sin_a, cos_a, 0.0))
    return right, np.cross(toward, right), toward


def _faces(asset: Asset, share: float) -> tuple[FloatArray, list[list[int]]]:
    """Return the triangles that face the camera, shape (n, 3, 3), and their colours."""
    _, _, toward = _camera()
    faces, colors = [], []
    for link in asset.links:
        motion = joint_motion(link.joint, share) if link.joint is not None else IDENTITY
        for part in link.parts:
            # Small faces sort better by depth.
            mesh = mesh_of(part).subdivide().subdivide()
            normals = mesh.face_normals @ motion.rotation.T
            seen = normals @ toward > 0
            shade = 0.55 + 0.45 * np.clip(normals[seen] @ _LIGHT, 0.0, 1.0)
            corners = motion.apply_all(mesh.triangles[seen].reshape(-1, 3)).reshape(-1, 3, 3)
            faces.append(corners)
            colors.append(np.outer(shade, _MOVING if link.joint is not None else _BASE))
    return np.concatenate(faces), np.concatenate(colors).astype(int).tolist()
