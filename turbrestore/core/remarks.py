"""What is said about a clip: remarks that are in doubt, and counts."""


class Doubt(str):
    """A remark on a clip that a person has to check; others say what was done, and need no attention."""

    __slots__ = ()


def counted(count: int, noun: str) -> str:
    """Write a count with its noun, such as ``1 frame`` and ``2 frames``."""
    return f"{count} {noun}{'s' * (count != 1)}"
