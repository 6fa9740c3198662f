"""Stages that run step by step: a generator yields a state after each step and returns the result of the stage.

The loop belongs to the caller, who may show progress, keep a checkpoint or stop between any two steps::

    def find_root(...) -> Generator[State, None, Result]:
        while not converged:
            state = step(state)
            yield state
        return Result(...)
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

State = TypeVar("State")
Result = TypeVar("Result")
# Called as ``progress(stage, done, total)``.
Progress = Callable[[str, int, int], None]


def finish(steps: Generator[State, None, Result], on_state: Callable[[State], None] | None = None) -> Result:
    """Run a stage to its end.

    Parameters
    ----------
    steps : generator
        Yields a state after each step and returns the result.
    on_state : callable, optional
        Called with every state.

    Returns
    -------
    object
        What the generator returns.

    Examples
    --------
    >>> def halve(number):
    ...     while number > 1:
    ...         number /= 2
    ...         yield number
    ...     return f"ended at {number}"
    >>> finish(halve(8), print)
    4.0
    2.0
    1.0
    'ended at 1.0'
    """
    while True:
        try:
            state = next(steps)
        except StopIteration as end:
            return end.value
        if on_state is not None:
            on_state(state)


def step_counter(progress: Progress | None, stage: str, total: int) -> Callable[[object], None]:
    """Turn ``progress(stage, done, total)`` into an observer of the states of one stage, which counts them.

    Parameters
    ----------
    progress : callable or None
    stage : str
        Name of the stage.
    total : int
        Largest number of steps.

    Returns
    -------
    callable
        Takes a state, for :func:`finish`.

    Examples
    --------
    >>> observe = step_counter(lambda stage, done, total: print(stage, done, total), "filter", 5)
    >>> observe("any state")
    filter 1 5
    """
    done = 0

    def observe(_: object) -> None:
        nonlocal done
        done = min(done + 1, total)
        if progress is not None:
            progress(stage, done, total)

    return observe
