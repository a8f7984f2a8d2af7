"""Epochs of the group secret: periods of mission time, each with its own secret.

Mission time is divided into epochs. A one-way function computes the group secret of an epoch from the secret of the
epoch before it. A vehicle keeps the secrets of its clock's present epoch and of the epoch before, and erases older
secrets. An attacker who captures the vehicle therefore cannot decrypt older datagrams.

The clocks of the vehicles need not agree, and the clock of a vehicle may be lost after a reboot:

- Only the vehicle's own clock erases secrets. If the clock was set back, it shows a wrong epoch. The vehicle therefore
  also counts the epochs since its start, beginning with the epoch of its bundle, and never uses an epoch before the
  counted one.
- A vehicle opens datagrams of any epoch up to `MAX_EPOCHS_AHEAD` epochs after its clock's epoch. Such datagrams do not
  change its clock.
- A vehicle sends in the latest epoch in which it has received a datagram, so that vehicles with a faster clock can open
  its datagrams. This epoch is never more than `MAX_EPOCHS_FOLLOWED` epochs ahead of the vehicle's own clock. An
  attacker with the keys of one vehicle can therefore make other vehicles send in a later epoch, but all vehicles can
  still open their datagrams.
"""

import math
from collections import deque
from collections.abc import Callable

from ucp.secure.bundle import LAST_EPOCH, Bundle
from ucp.secure.crypto_suite import SenderKeys, next_epoch_secret

MAX_EPOCHS_AHEAD = 4096
"""Maximum number of epochs that a datagram may be ahead of the receiver's clock: four weeks with epochs of 600 s."""
MAX_EPOCHS_FOLLOWED = MAX_EPOCHS_AHEAD // 2
"""Maximum number of epochs by which a vehicle's datagrams may be ahead of its own clock. The clocks of receivers may be
behind this clock.
"""
MAX_CACHED_KEYS = 4096
"""Maximum number of cached sender keys. Above it, the cache is emptied."""


class EpochSecrets:
    """The group secrets that one vehicle keeps, one for each epoch.

    `save` is called with the vehicle's new bundle after each change of the clock's epoch. The new bundle does not
    contain the older secrets.
    """

    def __init__(
        self,
        bundle: Bundle,
        save: Callable[[Bundle], None],
        sender_keys: Callable[[bytes, bytes, int, int, bytes], SenderKeys] = SenderKeys,
    ) -> None:
        self._bundle = bundle
        self._mission = bundle.public.mission
        self._save = save
        self._derive_keys = sender_keys
        self._previous_secret: bytes | None = None
        """The secret of the epoch before the clock's epoch. None if this incarnation never had it."""
        self._later: deque[bytes] = deque()
        """The secrets of the epochs after the clock's epoch, in order. Each one is computed when a datagram of its
        epoch arrives.
        """
        self._followed = 0
        self._started_s: float | None = None
        self._until_s = -math.inf
        """Mission second at which the clock's epoch ends."""
        self._first = bundle.epoch
        self._sender_keys: dict[tuple[int, int, bytes], SenderKeys] = {}

    @property
    def bundle(self) -> Bundle:
        """The vehicle's bundle, with the group secret of the clock's epoch."""
        return self._bundle

    @property
    def current(self) -> int:
        """The epoch in which this vehicle sends."""
        return max(self._bundle.epoch, self._followed)

    def set_clock(self, now: float) -> None:
        """Set the clock to mission second `now`. If a later epoch has begun, erase the older secrets."""
        if now < self._until_s:
            return
        if self._started_s is None:
            self._started_s = now
        epoch_s = self._bundle.public.epoch_s
        shown, since_start = int(now // epoch_s), int((now - self._started_s) // epoch_s)
        epoch = min(LAST_EPOCH, max(shown, self._first + since_start))
        if epoch > self._bundle.epoch:
            self._advance_to(epoch)
        self._until_s = min((shown + 1) * epoch_s, self._started_s + (since_start + 1) * epoch_s)

    def can_open(self, epoch: int) -> bool:
        """Return whether the vehicle has the group secret of this epoch, or can compute it."""
        later = epoch - self._bundle.epoch
        return 0 <= later <= MAX_EPOCHS_AHEAD or (later == -1 and self._previous_secret is not None)

    def follow(self, epoch: int) -> None:
        """Send all further datagrams in this epoch or a later one, because another vehicle with the group secret sends
        in this epoch. The vehicle follows at most to `MAX_EPOCHS_FOLLOWED` epochs after the epoch of its own clock.
        """
        self._followed = max(self._followed, min(epoch, self._bundle.epoch + MAX_EPOCHS_FOLLOWED))

    def _advance_to(self, epoch: int) -> None:
        """Move the clock to a later epoch. Keep the secret of the epoch directly before it, and erase older secrets."""
        before, secret = self._previous_secret, self._bundle.group_secret
        for _ in range(epoch - self._bundle.epoch):
            before = secret
            secret = self._later.popleft() if self._later else next_epoch_secret(secret, self._mission)
        self._previous_secret = before
        self._bundle = self._bundle.at_epoch(epoch, secret)
        self._sender_keys = {known: keys for known, keys in self._sender_keys.items() if known[0] >= epoch - 1}
        self._save(self._bundle)

    def is_near(self, epoch: int) -> bool:
        """Return true if the epoch is the clock's epoch, the epoch in which this vehicle sends, or next to one of these
        two.
        """
        return abs(epoch - self._bundle.epoch) <= 1 or abs(epoch - self.current) <= 1

    def cached_keys(self, epoch: int, sender: int, boot: bytes) -> SenderKeys | None:
        """Return the cached keys with which this sender, since its start `boot`, encrypts datagrams in this epoch.
        Return None if no keys are cached.
        """
        return self._sender_keys.get((epoch, sender, boot))

    def derive_keys(self, epoch: int, sender: int, boot: bytes) -> SenderKeys:
        """Derive the keys with which this sender, since its start `boot`, encrypts datagrams in this epoch.
        `can_open(epoch)` must be true.
        """
        return self._derive_keys(self._secret(epoch), self._mission, epoch, sender, boot)

    def remember(self, epoch: int, sender: int, boot: bytes, keys: SenderKeys) -> None:
        """Cache the keys of a sender.

        The caller calls this only for a boot that a signature has proved authentic, because an attacker without keys
        must not fill the cache.
        """
        if (epoch, sender, boot) in self._sender_keys:
            return
        if len(self._sender_keys) >= MAX_CACHED_KEYS:
            self._sender_keys.clear()  # a sender that restarts again and again must not fill the memory
        self._sender_keys[epoch, sender, boot] = keys

    def _secret(self, epoch: int) -> bytes:
        later = epoch - self._bundle.epoch
        if later == -1:
            assert self._previous_secret is not None, "can_open(epoch) is true"
            return self._previous_secret
        while len(self._later) < later:
            newest = self._later[-1] if self._later else self._bundle.group_secret
            self._later.append(next_epoch_secret(newest, self._mission))
        return self._later[later - 1] if later else self._bundle.group_secret
