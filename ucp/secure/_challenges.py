"""Challenge messages. A receiver sends a challenge to find out whether a sender is active now (compare Echo in RFC
9175).

A vehicle that boots during a mission has missed earlier datagrams. Its replay windows are therefore incomplete, and it
cannot distinguish a new datagram from a recorded one. It broadcasts a *challenge*. Each other vehicle answers with an
*echo*. An echo names the challenge, and the next sequence number that the sender of the echo will use. An echo proves
that its sender is active, because the sender signs the echo, and an attacker cannot have recorded the echo before the
challenge. After the echo, the receiver accepts datagrams of this sender from this sequence number on.

A receiver also challenges a sender whose boot is older than the known one. The boot may be recorded, or the sender may
have lost its clock and its disk.

The receiver collects the echoes for `TRUST_DELAY_S`, or until all vehicles have answered. During this time it receives
the revocations that it missed, before it trusts any sender.

An attacker may also record and replay challenges and echoes. A receiver therefore answers each challenge once, and
accepts one echo of each sender to a challenge. After a receiver has accepted a later boot of a sender, it ignores
echoes to older challenges of this sender. A repeated challenge or echo is dropped before its signature is verified.
"""

CHALLENGE_INTERVAL_S = 5.0
"""Minimum time in mission seconds between two challenges to the same vehicles."""
TRUST_DELAY_S = 2.0
"""Maximum number of mission seconds between the first challenge and the first accepted sender. It applies if some
vehicles do not answer.
"""
MAX_REMEMBERED_BOOTS = 256
"""Maximum number of starts (boots) of one sender for which a receiver remembers the newest challenge."""
ALL = 0
"""The target of a challenge that is sent to all vehicles."""


class PendingChallenges:
    """The challenges that one vehicle has sent since its last start, and whose echoes it still accepts. The target of a
    challenge is an agent ID or `ALL`.
    """

    def __init__(self) -> None:
        self.first_at: float | None = None
        """The mission second of the first challenge to all vehicles. None before this challenge."""
        self._due: set[int] = set()
        self._sent_at: dict[int, float] = {}
        self._pending: dict[int, int] = {}
        """Target -> sequence number of the newest challenge that was sent to this target."""
        self._closed: dict[int, int] = {}
        """Sender -> smallest sequence number of a challenge to which an echo of this sender still counts."""

    @property
    def is_due(self) -> bool:
        """True if a challenge is due but not sent yet."""
        return bool(self._due)

    def ask(self, target: int, now: float) -> None:
        """Schedule a challenge to this target, unless one was sent recently."""
        if now >= self._sent_at.get(target, now - CHALLENGE_INTERVAL_S) + CHALLENGE_INTERVAL_S:
            self._due.add(target)

    def take_due(self, now: float) -> list[int]:
        """Return the targets of the challenges to send at mission second `now`."""
        due, self._due = sorted(self._due), set()
        self._sent_at.update(dict.fromkeys(due, now))
        if ALL in due and self.first_at is None:
            self.first_at = now
        return due

    def sent(self, target: int, sequence: int) -> None:
        """Record the sequence number of a challenge that was sent to this target."""
        self._pending[target] = sequence

    def is_pending(self, sequence: int, sender: int) -> bool:
        """Return whether this sequence number belongs to the newest challenge to this sender or to all vehicles, and an
        echo of this sender to this challenge still counts.
        """
        is_newest = sequence in (self._pending.get(ALL), self._pending.get(sender))
        return is_newest and sequence >= self._closed.get(sender, 0)

    def close(self, sender: int, next_sequence: int) -> None:
        """Ignore further echoes of this sender to challenges with a sequence number below `next_sequence`."""
        self._closed[sender] = next_sequence


class ReceivedChallenges:
    """The newest challenge of each start (boot) of one sender. The caller adds only authentic challenges."""

    def __init__(self) -> None:
        self._newest: dict[bytes, int] = {}

    def is_new(self, boot: bytes, sequence: int) -> bool:
        """Return whether this challenge is newer than all received challenges of this boot."""
        return sequence > self._newest.get(boot, -1)

    def add(self, boot: bytes, sequence: int) -> None:
        """Record a challenge as received. If more than MAX_REMEMBERED_BOOTS boots are recorded, forget the boot that
        was added first.
        """
        self._newest[boot] = sequence
        if len(self._newest) > MAX_REMEMBERED_BOOTS:
            del self._newest[next(iter(self._newest))]
