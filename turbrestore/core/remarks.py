"""Words about a clip: remarks that a person has to check, and counts."""


class Doubt(str):
    """A remark that a person has to check; other remarks only say what was done."""

    __slots__ = ()


def counted(count: int, noun: str) -> str:
    """Write a count with its noun, such as ``1 frame`` and ``2 frames``."""
    return f"{count} {noun}{'s' * (count != 1)}"
