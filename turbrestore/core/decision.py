"""A record of each choice that was made on the way to a result, and why."""

from __future__ import annotations

from dataclasses import dataclass

from .verdict import CheckKind


@dataclass(frozen=True)
class Decision:
    """One choice made from the data.

    Attributes
    ----------
    subject : str
        Subject in a word or two: ``"blur"``, ``"overshoot"``, ``"border"``.
    choice : str
        The choice, one line.
    reason : str
        The figures that led to the choice, one line.
    check : CheckKind or None
        What it makes doubtful about the result, whatever was chosen.

    Examples
    --------
    >>> decision = Decision("blur", "none removed", "width 0.42 ± 0.30 px is no more than that of a sharp image")
    >>> decision.subject, decision.choice
    ('blur', 'none removed')
    >>> print(decision)
    blur: none removed; width 0.42 ± 0.30 px is no more than that of a sharp image
    """

    subject: str
    choice: str
    reason: str
    check: CheckKind | None = None

    def __str__(self) -> str:
        return f"{self.subject}: {self.choice}; {self.reason}"
