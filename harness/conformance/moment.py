"""A moment of the reference, to go back to: much less work than to lead it there again."""

from collections import deque
from typing import Any

from harness.conformance.reference_model import Model

CONTAINERS = frozenset((bytearray, set, list, deque, dict))


class Moment:
    """All that matters of a model now, to the last bit.

    What is only counted for a report is not; nor is a timer that is paused: between inputs none is.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._parts = [(part, *_sorted(part)) for part in (vars(model), vars(model.state), vars(model.state.chain))]
        self._deadlines = [(timer, timer.deadline) for timer in model.state.timers]

    def put_back(self) -> Model:
        """The model, as it was."""
        for part, plain, containers in self._parts:
            part.update(plain)
            for name, value in containers:
                part[name] = _copied(value)
        for timer, deadline in self._deadlines:
            timer.deadline = deadline
        return self._model


def _sorted(part: dict[str, Any]) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """What stays as it is, and copies of what changes."""
    containers = [(name, _copied(value)) for name, value in part.items() if type(value) in CONTAINERS]
    return {name: value for name, value in part.items() if type(value) not in CONTAINERS}, containers


def _copied(value: Any) -> Any:
    if type(value) is dict and value and type(next(iter(value.values()))) is list:  # counted, by candidate
        return {key: item.copy() for key, item in value.items()}
    return value.copy()
