"""Limit the processor time that an agent spends on forged datagrams.

Two steps of opening a datagram are expensive. A budget limits their number: it holds some tokens, and each step takes
one. If no token is left, the agent drops the datagram before the step.

- *Wrong signatures.* The verification of a signature takes more than 100 us. An attacker without keys cannot make an
  agent verify a signature, because the authenticated encryption covers the signature. An attacker with the keys of one
  vehicle can do this in the name of any sender. Each sender therefore has a budget of its own, so that such forgeries
  do not affect the datagrams of other senders.
- *Keys of an unknown boot.* The derivation of these keys takes longer than all other steps for a datagram with a wrong
  tag. An attacker without keys can invent any number of boots (starts of a sender). All senders share one budget. If
  each sender had a smaller budget of its own, an attacker could exhaust the budget of one sender with fewer datagrams,
  because the attacker also chooses the sender. The accepted boots of all senders need no token, because the agent keeps
  their keys.
"""

import math


class TokenBudget:
    """A limit for the rate of an expensive step. Each step takes a token. The budget holds at most `burst` tokens, and
    gains `per_s` tokens each mission second. If `per_s` is infinite, there is no limit.
    """

    __slots__ = ("_burst", "_per_s", "_since_s", "_tokens")

    def __init__(self, per_s: float, burst: int) -> None:
        self._per_s = per_s
        self._burst = burst
        self._tokens = float(burst)
        self._since_s: float | None = None

    def has_token(self, now: float) -> bool:
        """Return whether a token is left at mission second `now`."""
        if self._tokens < self._burst and self._since_s is not None:
            self._tokens = min(self._burst, self._tokens + (now - self._since_s) * self._per_s)
        self._since_s = now
        return self._tokens >= 1

    def take(self) -> None:
        """Remove one token. An infinite budget does not change."""
        if self._per_s < math.inf:
            self._tokens -= 1
