"""An agent of another make with keys: what it sends is opened for the records, and reaches others as it is."""

import re
from collections.abc import Iterator
from typing import Any

from harness.errors import AgentFailedError
from harness.play.simulation.foreign._answer import AgentLacksError, Outcome
from harness.play.simulation.foreign._foreign_agent import ForeignAgent
from ucp.messages import MalformedDatagramError
from ucp.secure.bundle import Bundle
from ucp.secure.envelope import REVOCATION, read_clear_header
from ucp.secure.opening import Opener
from ucp.secure.secured_agent import OutgoingDatagram
from ucp.trace import in_base64

HIDDEN = "(a secret)"
_DIGITS = re.compile("[0-9a-fA-F]{8,}")


class SecuredForeignAgent(ForeignAgent):
    """One that was handed this `bundle`; all other arguments are ForeignAgent's. Its secrets are in no sentence."""

    def __init__(self, bundle: Bundle, *arguments: Any, **options: Any) -> None:
        self._opener = Opener(bundle)
        self._secrets = [secret.hex() for secret in (bundle.private_key, bundle.group_secret)]
        super().__init__(*arguments, **options)

    def sealed_to_send(self) -> Iterator[OutgoingDatagram]:
        """What it broadcasts since it was last asked, in order; what nobody can open is no message of its own."""
        sent, self._sent = self._sent, []
        for data, _ in sent:
            try:
                self.messages_sent -= read_clear_header(data).type == REVOCATION  # which is none of its messages
                opened = self._opener.open(data)
            except MalformedDatagramError:
                yield OutgoingDatagram(data)
                continue
            said = opened.datagram
            is_its_own = said.sender == self.agent_id
            yield OutgoingDatagram(data, said.sequence, said.message if is_its_own else None, opened.recorded)

    def revoke(self, body: bytes, now: float) -> None:
        """The authority says whose keys are revoked."""
        given = f'{{"t":{self._at(now)},"command":"revoke","revocation":"{in_base64(body)}"}}'
        self._accepted("revoke", self._give(given, "the command revoke", now).told)

    def _failure(self, outcome: Outcome, detail: str) -> AgentFailedError:
        return super()._failure(outcome, self._hidden(detail))

    def _lacks(self, words: str) -> AgentLacksError:
        return super()._lacks(self._hidden(words))

    def _hidden(self, words: str) -> str:
        """Also if a secret is cut off."""

        def shown(digits: re.Match[str]) -> str:
            text = digits[0].lower()
            return HIDDEN if any(text in secret or secret in text for secret in self._secrets) else digits[0]

        return _DIGITS.sub(shown, words)
