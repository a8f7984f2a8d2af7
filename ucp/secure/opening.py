"""Open the secured datagrams of a capture after a mission.

An agent drops replayed and old datagrams (`ucp.secure.session`). The reader of a capture wants to see all datagrams, so
an opener accepts datagrams in any order, and the same datagram any number of times. It still rejects datagrams that are
not authentic.
"""

from ucp.messages import MalformedDatagramError
from ucp.secure.bundle import Bundle
from ucp.secure.crypto_suite import SenderKeys, next_epoch_secret, verify
from ucp.secure.envelope import CONTROL_NAMES, read_clear_header
from ucp.secure.sealed_datagrams import OpenedDatagram, decrypt, parse_body, signing_domain

EPOCHS_AHEAD = 4096
"""Maximum number of epochs after the bundle's epoch for which the opener computes secrets: four weeks with epochs of
600 s.
"""


class DatagramOpener:
    """A reader that decrypts the datagrams of all vehicles of a mission with the bundle (the key file) of one vehicle.

    It opens datagrams of the bundle's epoch and of later epochs. Secrets of earlier epochs cannot be computed.
    """

    def __init__(self, bundle: Bundle) -> None:
        self._public = bundle.public
        self._first = bundle.epoch
        self._secrets = [bundle.group_secret]
        self._keys: dict[tuple[int, int, bytes], SenderKeys] = {}

    def open(self, datagram: bytes) -> OpenedDatagram:
        """Return the content of a datagram. Raises MalformedDatagramError for a datagram of these kinds:

        - a control datagram, which contains no message
        - a datagram that is not authentic
        - a datagram whose sender is not on the roster
        - a datagram of an epoch before that of the bundle, or more than `EPOCHS_AHEAD` epochs later
        """
        clear = read_clear_header(datagram)
        if clear.type in CONTROL_NAMES:
            raise MalformedDatagramError("no message")
        public_key = self._public.vehicles.get(clear.sender)
        if public_key is None:
            raise MalformedDatagramError("sender not on the roster")
        sealed_by = clear.epoch, clear.sender, clear.boot
        keys = self._keys.get(sealed_by) or SenderKeys(self._secret(clear.epoch), self._public.mission, *sealed_by)
        body, claim = decrypt(keys, datagram, clear, signing_domain(self._public.mission), public_key)
        if not verify(claim):
            raise MalformedDatagramError("not signed by its sender")
        self._keys[sealed_by] = keys
        return parse_body(clear, body)

    def _secret(self, epoch: int) -> bytes:
        later = epoch - self._first
        if not 0 <= later <= EPOCHS_AHEAD:
            raise MalformedDatagramError("epoch out of range")
        while len(self._secrets) <= later:
            self._secrets.append(next_epoch_secret(self._secrets[-1], self._public.mission))
        return self._secrets[later]
