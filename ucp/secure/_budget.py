"""A limit for the processor time that forged datagrams take.

An attacker without keys cannot make an agent verify a signature, because the authenticated encryption covers it. An
attacker with the keys of one vehicle can. Each wrong signature takes more than 100 us. A budget limits their number: it
holds some tokens, and each wrong signature takes one. Without tokens, the agent drops datagrams unverified. Each sender
has a budget of its own, so that forgeries in its name do not affect the datagrams of other senders.
"""

import math

BURST = 32
"""Number of wrong signatures in the name of one sender that an agent verifies without a pause."""


class VerificationBudget:
    """A budget of tokens for wrong signatures. It gains `per_s` tokens each mission second. An infinite budget sets no
    limit.
    """

    __slots__ = ("_per_s", "_since_s", "_tokens")

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._tokens = float(BURST)
        self._since_s: float | None = None

    def has_token(self, now: float) -> bool:
        """Return whether a token is left at mission second `now`, so that a signature may be verified."""
        if self._tokens < BURST and self._since_s is not None:
            self._tokens = min(BURST, self._tokens + (now - self._since_s) * self._per_s)
        self._since_s = now
        return self._tokens >= 1

    def take(self) -> None:
        """Remove one token, because a signature was wrong. An infinite budget does not change."""
        if self._per_s < math.inf:
            self._tokens -= 1
