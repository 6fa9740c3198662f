"""What moves in the pictures of the documentation."""

from __future__ import annotations

from turbrestore.synthesis.moving_objects import MovingObject


def traffic(height: int, width: int) -> tuple[MovingObject, ...]:
    """Two objects that drive along the road of :func:`street` in opposite directions."""
    scale = width / 224
    return (
        MovingObject((20 * scale, 172 * scale), (3.0 * scale, 0.0), (15 * scale, 7 * scale), 0.2, 0.6),
        MovingObject((200 * scale, 208 * scale), (-3.6 * scale, 0.0), (20 * scale, 9 * scale), 0.8, 2.2),
    )
