"""What moves in the pictures of the documentation, and a label."""

from __future__ import annotations

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.synthesis.moving_objects import MovingObject


def traffic(height: int, width: int) -> tuple[MovingObject, ...]:
    """Two objects that drive along the road of :func:`street` in opposite directions."""
    scale = width / 224
    return (
        MovingObject((20 * scale, 172 * scale), (3.0 * scale, 0.0), (15 * scale, 7 * scale), 0.2, 0.6),
        MovingObject((200 * scale, 208 * scale), (-3.6 * scale, 0.0), (20 * scale, 9 * scale), 0.8, 2.2),
    )


def label(height: int, width: int) -> FloatArray:
    """Draw a label with a QR code, which says turbrestore, on cardboard."""
    modules = cv2.QRCodeEncoder.create().encode("turbrestore").astype(np.float32) / 255
    side = min(height, width) // 2
    scene = np.full((height, width), 0.35, np.float32)
    top, left = (height - side) // 2, (width - side) // 2
    scene[top - 12 : top + side + 12, left - 20 : left + side + 20] = 0.9
    code = cv2.resize(modules, (side, side), interpolation=cv2.INTER_AREA)
    scene[top : top + side, left : left + side] = 0.08 + 0.82 * code
    return scene
