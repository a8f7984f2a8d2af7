"""Opens datagrams after the fact, as a capture has them: in any order, as often as they are there, of any epoch.

An agent opens what is fresh and drops the rest (`ucp.secure.session`). Whoever looks at what crossed the air wants to
see all of it; what is not authentic is told here, too.
"""

from ucp.messages import MalformedDatagramError
from ucp.secure.bundle import Bundle
from ucp.secure.crypto_suite import SenderKeys, next_epoch_secret, verify
from ucp.secure.envelope import REVOCATION, read_clear
from ucp.secure.sealed_datagrams import Opened, decrypted, domain_of, understood

EPOCHS_AHEAD = 4096
"""How far the secrets are made that no clock asks for: four weeks, if an epoch has 600 s."""


class Opener:
    """Opens what any vehicle of a mission sent, from the bundle of one, in the bundle's epoch and later ones."""

    def __init__(self, bundle: Bundle) -> None:
        self._public = bundle.public
        self._first = bundle.epoch
        self._secrets = [bundle.group_secret]
        self._keys: dict[tuple[int, int, bytes], SenderKeys] = {}

    def open(self, datagram: bytes) -> Opened:
        """What the datagram says.

        Raises MalformedDatagramError: for a revocation, which is not sealed, and for whatever is not authentic, of
        an epoch before the bundle's, or of nobody who has keys.
        """
        clear = read_clear(datagram)
        if clear.type == REVOCATION:
            raise MalformedDatagramError("not sealed")
        public_key = self._public.vehicles.get(clear.sender)
        if public_key is None:
            raise MalformedDatagramError("sender not on the roster")
        sealed_by = clear.epoch, clear.sender, clear.boot
        keys = self._keys.get(sealed_by) or SenderKeys(self._secret(clear.epoch), self._public.mission, *sealed_by)
        body, claim = decrypted(keys, datagram, clear, domain_of(self._public.mission), public_key)
        if not verify(claim):
            raise MalformedDatagramError("not signed by its sender")
        self._keys[sealed_by] = keys
        return understood(clear, body)

    def _secret(self, epoch: int) -> bytes:
        later = epoch - self._first
        if not 0 <= later <= EPOCHS_AHEAD:
            raise MalformedDatagramError("epoch out of range")
        while len(self._secrets) <= later:
            self._secrets.append(next_epoch_secret(self._secrets[-1], self._public.mission))
        return self._secrets[later]
