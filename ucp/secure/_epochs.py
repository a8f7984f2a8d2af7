"""Epochs: the group secret moves on with mission time, one way, so that what is captured later opens nothing earlier.

The secrets of the current epoch and of the one before are held, older ones are erased. Clocks need not agree: what is
authentic and of a later epoch takes a vehicle there, up to `AHEAD` epochs before its own clock, so that nobody who has
keys can drive a swarm out of reach of those who do not hear it.
"""

import math
from collections.abc import Callable

from ucp.secure.bundle import LAST_EPOCH, Bundle
from ucp.secure.crypto_suite import SenderKeys, next_epoch_secret

AHEAD = 8
"""Epochs that others may be ahead of one's own clock: 80 minutes, if an epoch has 600 s."""
SENDERS_KEPT = 4096


class Epochs:
    """The group secrets of one vehicle. `keep` is given its bundle each time that older secrets are gone from it."""

    def __init__(
        self,
        bundle: Bundle,
        keep: Callable[[Bundle], None],
        sender_keys: Callable[[bytes, bytes, int, int, bytes], SenderKeys] = SenderKeys,
    ) -> None:
        self._bundle = bundle
        self.current = bundle.epoch
        """What is sent now is sent in this one."""
        self._mission = bundle.public.mission
        self._keep = keep
        self._derived = sender_keys
        self._before: bytes | None = None
        """The secret of the epoch before the current one, if it was ever known in this life."""
        self._clock = bundle.epoch
        self._looked_at = math.inf, -math.inf
        """From when until when the clock shows the epoch that it does; nobody has looked yet."""
        self._sender_keys: dict[tuple[int, int, bytes], SenderKeys] = {}

    @property
    def bundle(self) -> Bundle:
        """The vehicle's, with the secret of the current epoch."""
        return self._bundle

    def look_at(self, now: float) -> None:
        """It is `now`, in mission seconds: move on if an epoch is over."""
        since, until = self._looked_at
        if since <= now < until:
            return
        epoch_s = self._bundle.public.epoch_s
        epoch = int(now // epoch_s)
        self._looked_at = epoch * epoch_s, (epoch + 1) * epoch_s
        self._clock = min(LAST_EPOCH, max(0, epoch))
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
        self.current = epoch
        self._sender_keys = {known: keys for known, keys in self._sender_keys.items() if known[0] >= epoch - 1}
        self._keep(self._bundle)

    def keys_of(self, epoch: int, sender: int, boot: bytes) -> SenderKeys:
        """What that sender seals with in its life `boot`; the epoch is one that it `can_open`."""
        known = self._sender_keys.get((epoch, sender, boot))
        return known or self._derived(self._secret(epoch), self._mission, epoch, sender, boot)

    def remember(self, epoch: int, sender: int, boot: bytes, keys: SenderKeys) -> None:
        """They are authentic, and will be needed again."""
        if (epoch, sender, boot) in self._sender_keys:
            return
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
