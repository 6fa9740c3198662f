"""Stages that run step by step: a generator yields a state after each step and returns the result of the stage.

The loop belongs to the caller, who may show progress, keep a checkpoint or stop between any two steps.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

State = TypeVar("State")
Result = TypeVar("Result")
# Called as ``progress(stage, done, total)``.
Progress = Callable[[str, int, int], None]


def finish(steps: Generator[State, None, Result], on_state: Callable[[State], None] | None = None) -> Result:
    """Run a stage to its end."""
    while True:
        try:
            state = next(steps)
        except StopIteration as end:
            return end.value
        if on_state is not None:
            on_state(state)


def step_counter(progress: Progress | None, stage: str, total: int) -> Callable[[object], None]:
    """Turn ``progress(stage, done, total)`` into an observer of the states of one stage, which counts them."""
    done = 0

    def observe(_: object) -> None:
        nonlocal done
        done = min(done + 1, total)
        if progress is not None:
            progress(stage, done, total)

    return observe
