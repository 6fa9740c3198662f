"""Records of the thresholds of a detector, each with its unit and with what it was set by.

The source of a threshold begins with its kind:

- ``theory``, ``bits`` (of a number or of a codec) or ``cost`` (memory, time): it follows from what is named;
- ``measured``: a figure of clips, which is given;
- ``test``: names a test that fails where the threshold is half or double what it is;
- ``chosen``: no test and no figure holds it.  These are debts, and ``tests/core/test_thresholds.py`` counts them.
"""

from __future__ import annotations

from dataclasses import field
from typing import TypeVar

Value = TypeVar("Value", int, float)


def threshold(value: Value, unit: str, source: str) -> Value:
    """Declare a field of a frozen record of thresholds: its value, its unit ("1" for shares), and its source."""
    declared: Value = field(default=value, metadata={"unit": unit, "source": source})
    return declared
