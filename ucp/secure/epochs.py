"""Epochs: the group secret moves on with mission time, one way, so that what is captured later opens nothing earlier.

The secrets of the current epoch and of the one before are held, older ones are erased. Clocks need not agree: what is
authentic and of a later epoch takes a vehicle there, up to `AHEAD` epochs before its own clock, so that nobody who has
keys can drive a swarm out of reach of those who do not hear it.
"""

from collections.abc import Callable

from ucp.secure.bundle import LAST_EPOCH, Bundle
from ucp.secure.suite import SenderKeys, next_epoch_secret

AHEAD = 8
"""Epochs that others may be ahead of one's own clock: 80 minutes, if an epoch has 600 s."""
SENDERS_KEPT = 4096


class Epochs:
    """The group secrets of one vehicle. `keep` is given its bundle each time that older secrets are gone from it."""

    def __init__(self, bundle: Bundle, keep: Callable[[Bundle], None]) -> None:
        self._bundle = bundle
        self._mission = bundle.public.mission
        self._keep = keep
        self._before: bytes | None = None
        """The secret of the epoch before the current one, if it was ever known in this life."""
        self._clock = bundle.epoch
        self._sender_keys: dict[tuple[int, int, bytes], SenderKeys] = {}

    @property
    def bundle(self) -> Bundle:
        """The vehicle's, with the secret of the current epoch."""
        return self._bundle

    @property
    def current(self) -> int:
        """What is sent now is sent in this one."""
        return self._bundle.epoch

    def look_at(self, now: float) -> None:
        """It is `now`, in mission seconds: move on if an epoch is over."""
        self._clock = min(LAST_EPOCH, max(0, int(now // self._bundle.public.epoch_s)))
        if self._clock > self.current:
            self.follow(self._clock)

    def can_open(self, epoch: int) -> bool:
        """Whether the secret of that epoch is held, or may be made."""
        if epoch > self.current:
            return epoch <= min(LAST_EPOCH, self._clock + AHEAD)
        return epoch == self.current or (epoch == self.current - 1 and self._before is not None)

    def follow(self, epoch: int) -> None:
        """Go on to a later epoch."""
        before, secret = self._before, self._bundle.group_secret
        for _ in range(epoch - self.current):
            before, secret = secret, next_epoch_secret(secret, self._mission)
        self._before = before
        self._bundle = self._bundle.at_epoch(epoch, secret)
        self._sender_keys = {known: keys for known, keys in self._sender_keys.items() if known[0] >= epoch - 1}
        self._keep(self._bundle)

    def keys_of(self, epoch: int, sender: int, boot: bytes) -> SenderKeys:
        """What that sender seals with in its life `boot`; the epoch is one that it `can_open`."""
        known = self._sender_keys.get((epoch, sender, boot))
        return known or SenderKeys(self._secret(epoch), self._mission, epoch, sender, boot)

    def remember(self, epoch: int, sender: int, boot: bytes, keys: SenderKeys) -> None:
        """They are authentic, and will be needed again."""
        if len(self._sender_keys) >= SENDERS_KEPT:
            self._sender_keys.clear()  # of those who restart over and over
        self._sender_keys[epoch, sender, boot] = keys

    def _secret(self, epoch: int) -> bytes:
        if epoch == self.current - 1:
            assert self._before is not None, "it can open that epoch"
            return self._before
        secret = self._bundle.group_secret
        for _ in range(epoch - self.current):
            secret = next_epoch_secret(secret, self._mission)
        return secret
