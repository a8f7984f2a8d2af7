"""Epochs of the group secret.

Mission time is divided into epochs. A one-way function computes the group secret of an epoch from the secret of the
epoch before it. A vehicle keeps the secrets of the current epoch and of the one before, and erases older ones. An
attacker who captures the vehicle therefore cannot decrypt older datagrams.

The clocks of the vehicles need not agree. An authentic datagram of a later epoch moves its receiver on to this epoch.
The limit is `MAX_EPOCHS_AHEAD` epochs ahead of the receiver's own clock. Otherwise an attacker with keys could move
some vehicles so far ahead that they no longer accept datagrams of the vehicles that the attacker did not reach.
"""

import math
from collections.abc import Callable

from ucp.secure.bundle import LAST_EPOCH, Bundle
from ucp.secure.crypto_suite import SenderKeys, next_epoch_secret

MAX_EPOCHS_AHEAD = 8
"""Maximum number of epochs that a datagram may be ahead of the receiver's clock: 80 minutes with epochs of 600 s."""
MAX_CACHED_KEYS = 4096
"""Maximum number of cached sender keys. Above it, the cache is emptied."""


class Epochs:
    """The group secrets of one vehicle.

    `save` is called with the vehicle's new bundle after each change of the epoch. The new bundle no longer contains
    the older secrets.
    """

    def __init__(
        self,
        bundle: Bundle,
        save: Callable[[Bundle], None],
        sender_keys: Callable[[bytes, bytes, int, int, bytes], SenderKeys] = SenderKeys,
    ) -> None:
        self._bundle = bundle
        self.current = bundle.epoch
        """The epoch in which this vehicle sends."""
        self._mission = bundle.public.mission
        self._save = save
        self._derive_keys = sender_keys
        self._previous_secret: bytes | None = None
        """The secret of the epoch before the current one. None if this incarnation has not known it."""
        self._clock = bundle.epoch
        self._clock_interval = math.inf, -math.inf
        """Start and end of the clock's epoch in mission seconds. The interval is empty before the first call."""
        self._sender_keys: dict[tuple[int, int, bytes], SenderKeys] = {}

    @property
    def bundle(self) -> Bundle:
        """The vehicle's bundle, with the group secret of the current epoch."""
        return self._bundle

    def set_clock(self, now: float) -> None:
        """Set the clock to mission second `now`, and move on to the clock's epoch if it is a later one."""
        since, until = self._clock_interval
        if since <= now < until:
            return
        epoch_s = self._bundle.public.epoch_s
        epoch = int(now // epoch_s)
        self._clock_interval = epoch * epoch_s, (epoch + 1) * epoch_s
        self._clock = min(LAST_EPOCH, max(0, epoch))
        if self._clock > self.current:
            self.advance_to(self._clock)

    def can_open(self, epoch: int) -> bool:
        """Return whether the vehicle has the secret of this epoch, or may compute it."""
        if epoch > self.current:
            return epoch <= min(LAST_EPOCH, self._clock + MAX_EPOCHS_AHEAD)
        return epoch == self.current or (epoch == self.current - 1 and self._previous_secret is not None)

    def advance_to(self, epoch: int) -> None:
        """Move on to a later epoch, and erase the secrets of epochs before the previous one."""
        before, secret = self._previous_secret, self._bundle.group_secret
        for _ in range(epoch - self.current):
            before, secret = secret, next_epoch_secret(secret, self._mission)
        self._previous_secret = before
        self._bundle = self._bundle.at_epoch(epoch, secret)
        self.current = epoch
        self._sender_keys = {known: keys for known, keys in self._sender_keys.items() if known[0] >= epoch - 1}
        self._save(self._bundle)

    def sender_keys(self, epoch: int, sender: int, boot: bytes) -> SenderKeys:
        """Return the keys with which this sender seals in its incarnation `boot`. `can_open(epoch)` must be true."""
        known = self._sender_keys.get((epoch, sender, boot))
        return known or self._derive_keys(self._secret(epoch), self._mission, epoch, sender, boot)

    def remember(self, epoch: int, sender: int, boot: bytes, keys: SenderKeys) -> None:
        """Cache the keys of a sender. The caller calls this only after a signature has proved the sender authentic."""
        if (epoch, sender, boot) in self._sender_keys:
            return
        if len(self._sender_keys) >= MAX_CACHED_KEYS:
            self._sender_keys.clear()  # a sender that restarts again and again must not fill the memory
        self._sender_keys[epoch, sender, boot] = keys

    def _secret(self, epoch: int) -> bytes:
        if epoch == self.current - 1:
            assert self._previous_secret is not None, "can_open(epoch) is true"
            return self._previous_secret
        secret = self._bundle.group_secret
        for _ in range(epoch - self.current):
            secret = next_epoch_secret(secret, self._mission)
        return secret
