"""A record of each choice that was made on the way to a result, and why."""

from __future__ import annotations

from dataclasses import dataclass


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

    def __str__(self) -> str:
        return f"{self.subject}: {self.choice}; {self.reason}"
