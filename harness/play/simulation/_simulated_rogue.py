"""Run the rogue node, a sender of forged messages, in virtual time.

The rogue node receives every datagram at the time of sending. Its own datagrams arrive after the mean latency at every
living agent, except the imitated agent, which would drop a datagram in its own name.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from harness.play.rogue._journal import RogueJournal
from harness.play.rogue._rogue import RogueLogic
from harness.play.simulation.air import StrayDatagram, VirtualAir
from harness.scenario.changes import TimedInjection
from netem.medium import LATENCY
from ucp.messages import Message, encode

if TYPE_CHECKING:
    from harness.play.rogue._captured_bundle import CapturedKeys

MOMENT_S = LATENCY.mean_s


class VirtualRogue:
    """The rogue node on a simulated network. Its number follows the numbers of the agents."""

    def __init__(
        self,
        roster: Sequence[int],
        seed: int,
        air: VirtualAir,
        number: int,
        write: Callable[[dict[str, object]], None],
        captured: "CapturedKeys | None" = None,
        initial_data: bytes = b"",
    ) -> None:
        self._rogue = RogueLogic(roster, seed, captured=captured, initial_data=initial_data)
        self._roster = roster
        self._air = air
        self._number = number
        self._wakes_at: float | None = None
        self._journal = RogueJournal(write)

    @property
    def sent(self) -> dict[int, int]:
        """The number of datagrams that each injection has created so far."""
        return dict(self._rogue.sent)

    def receive_message(self, sender: int, sequence: int, message: Message, now: float) -> None:
        self.receive_datagram(encode(sender, sequence, message), now)

    def receive_datagram(self, datagram: bytes, now: float) -> None:
        self._rogue.receive(datagram, now)
        self._send(now)

    def begin(self, injected: TimedInjection, now: float) -> None:
        self._rogue.begin(injected.number, injected.injection, now)
        self._send(now)

    def wake(self, now: float) -> None:
        """Handle the timer for which the rogue node has waited."""
        self._wakes_at = None
        self._rogue.handle_timer(now)
        self._send(now)

    def close(self) -> None:
        self._journal.close()

    def _send(self, now: float) -> None:
        for injected in self._rogue.to_send():
            hearing = [
                number
                for number, agent in enumerate(self._roster)
                if agent != injected.source and (injected.receivers is None or agent in injected.receivers)
            ]
            self._air.inject(now + MOMENT_S, StrayDatagram(injected.source, injected.datagram), hearing)
            self._journal.add(injected, now)
        soonest = self._rogue.next_timer()
        if soonest is not None and (self._wakes_at is None or soonest < self._wakes_at):
            self._wakes_at = soonest
            self._air.schedule(soonest, self._number, None)
