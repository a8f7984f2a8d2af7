"""A timer as in the thesis (Section 3.2). It expires once, and can be paused and resumed. Its methods take the time as
an argument.
"""


class Timer:
    """A timer of an agent. `deadline` is a mission second. It is None while the timer is stopped or paused."""

    __slots__ = ("_paused", "deadline", "name")

    def __init__(self, name: str) -> None:
        self.name = name
        self.deadline: float | None = None
        self._paused: tuple[float, float] | None = None  # time of the pause, deadline before it

    @property
    def active(self) -> bool:
        return self.deadline is not None or self._paused is not None

    def start(self, now: float, duration_s: float) -> None:
        self.deadline = now + duration_s
        self._paused = None

    def stop(self) -> None:
        self.deadline = self._paused = None

    def pause(self, now: float) -> None:
        if self.deadline is not None:
            self._paused = now, self.deadline
            self.deadline = None

    def resume(self, now: float) -> None:
        """Continue after a pause. If the pause ended at the second at which it began, the deadline does not change."""
        if self._paused is not None:
            paused_at, deadline = self._paused
            self.deadline = deadline + (now - paused_at)
            self._paused = None
