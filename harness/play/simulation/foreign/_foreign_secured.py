"""Run a foreign agent that signs and encrypts its messages. The harness delivers the agent's datagrams unchanged. It
decrypts a copy of each datagram for the records.
"""

import re
from collections.abc import Iterator
from typing import Any

from harness.errors import AgentFailedError
from harness.play.simulation.foreign._answer import AgentLacksError, Outcome
from harness.play.simulation.foreign._foreign_agent import ForeignAgent
from ucp.messages import MalformedDatagramError
from ucp.secure.bundle import Bundle
from ucp.secure.envelope import CONTROL_NAMES, read_clear_header
from ucp.secure.opening import DatagramOpener
from ucp.secure.secured_agent import OutgoingDatagram
from ucp.trace import in_base64

HIDDEN = "(a secret)"
_DIGITS = re.compile("[0-9a-fA-F]{8,}")


class SecuredForeignAgent(ForeignAgent):
    """A foreign agent with the keys in `bundle`. The other arguments are those of `ForeignAgent`.

    Error messages do not contain the secrets of the agent.
    """

    def __init__(self, bundle: Bundle, *arguments: Any, **options: Any) -> None:
        self._opener = DatagramOpener(bundle)
        self._secrets = [secret.hex() for secret in (bundle.private_key, bundle.group_secret)]
        super().__init__(*arguments, **options)

    def sealed_to_send(self) -> Iterator[OutgoingDatagram]:
        """Yield the datagrams that the agent sent since the previous call, in order. A datagram that cannot be
        decrypted is yielded without a message.
        """
        sent, self._sent = self._sent, []
        for data, _ in sent:
            try:
                self.messages_sent -= read_clear_header(data).type in CONTROL_NAMES  # they are no messages of the agent
                opened = self._opener.open(data)
            except MalformedDatagramError:
                yield OutgoingDatagram(data)
                continue
            content = opened.datagram
            is_own = content.sender == self.agent_id
            yield OutgoingDatagram(data, content.sequence, content.message if is_own else None, opened.recorded)

    def revoke(self, body: bytes, now: float) -> None:
        """Give the agent a signed list of vehicles whose keys are revoked."""
        given = f'{{"t":{self._time_text(now)},"command":"revoke","revocation":"{in_base64(body)}"}}'
        self._checked_answer("revoke", self._give_input(given, "the command revoke", now).command_answer)

    def _failure(self, outcome: Outcome, detail: str) -> AgentFailedError:
        return super()._failure(outcome, self._hidden(detail))

    def _lacks_error(self, words: str) -> AgentLacksError:
        return super()._lacks_error(self._hidden(words))

    def _hidden(self, words: str) -> str:
        """Return the text without the agent's secrets and parts of them."""

        def shown(digits: re.Match[str]) -> str:
            text = digits[0].lower()
            return HIDDEN if any(text in secret or secret in text for secret in self._secrets) else digits[0]

        return _DIGITS.sub(shown, words)
