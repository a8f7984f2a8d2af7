"""The thesis's timer (Section 3.2): counts down, can be paused and resumed, and fires once. Time is an argument."""


class Timer:
    """`deadline` is in mission seconds; None while the timer is stopped or paused."""

    __slots__ = ("_remaining", "deadline", "name")

    def __init__(self, name: str) -> None:
        self.name = name
        self.deadline: float | None = None
        self._remaining: float | None = None

    @property
    def active(self) -> bool:
        return self.deadline is not None or self._remaining is not None

    def start(self, now: float, duration_s: float) -> None:
        self.deadline = now + duration_s
        self._remaining = None

    def stop(self) -> None:
        self.deadline = self._remaining = None

    def pause(self, now: float) -> None:
        if self.deadline is not None:
            self._remaining = self.deadline - now
            self.deadline = None

    def resume(self, now: float) -> None:
        if self._remaining is not None:
            self.deadline = now + self._remaining
            self._remaining = None
