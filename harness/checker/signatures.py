"""The signatures in the exports of a secured mission, and the trust in the public keys that verify them.

A signature proves nothing if an attacker could choose the key that verifies it. A user who checks exports therefore
needs an *anchor*: a copy of the public keys, or their fingerprint, that cannot come from the attacker. Without an
anchor, the checker can detect some edited exports, but it cannot confirm that an export is genuine.
"""

import base64
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.archive.exports import Export, ExportedBlock, ExportedHead
from harness.checker.judgement import agents
from ucp.block import Block

if TYPE_CHECKING:
    from ucp.secure.bundle import PublicKeys
    from ucp.secure.crypto_suite import UnverifiedSignature
    from ucp.secure.export_head import ExportHead

_Content = tuple[int, int, str, str, str | None]
"""The signed content of an exported block: agent, timestamp, event data, block hash and signature."""
MAX_U64 = 2**64 - 1


@dataclass(frozen=True)
class TrustedKeys:
    """The public keys of a mission."""

    public: "PublicKeys"
    anchor: str | None
    """Name of the source that confirms the keys. None if no source confirms them."""


def unanchored(exports: Iterable[Export], keys: TrustedKeys | None) -> str | None:
    """Return the reason why valid signatures do not prove that the exports of a secured mission are genuine. Return
    None if valid signatures prove this.
    """
    if keys is None:
        return "unsigned: no public keys are known that verify the signatures; name the key directory with --keys"
    if keys.anchor is None:
        return (
            "not anchored: the signatures match public.json, which lies next to the exports, so that an attacker could "
            "have replaced both; name your own copy of the public keys with --keys"
        )
    without_head = {export.agent_id for export in exports if export.head is None}
    if without_head:
        return (
            f"unsigned: the exports of {agents(without_head)} have no signed head, so order and number of their blocks "
            "are not proven"
        )
    return None


def is_older(export: Export, other: Export) -> bool:
    """Return true if the signed heads show that `export` is not newer than `other`, an export of the same vehicle."""
    if export.head is None or other.head is None:
        return False
    return (export.head.boot, export.head.number) <= (other.head.boot, other.head.number)


def are_signed(exports: Iterable[Export]) -> bool:
    """Return true if at least one export or block has a signature."""
    return any(
        export.head is not None or any(block.signature is not None for block in export.blocks()) for export in exports
    )


def vouch(exports: Iterable[Export], keys: TrustedKeys | None) -> tuple[list[str], str | None]:
    """Return two results: a list with a sentence for each export with a wrong signature, and the reason why correct
    signatures prove nothing. The reason is None if correct signatures prove that the exports are genuine.

    Without `keys`, the exports may be unsigned. They then count as exports of a mission without keys.
    """
    exports = list(exports)
    if keys is None and not are_signed(exports):
        return [], None
    problems: list[str] = []
    if keys is not None:
        checks = SignatureChecks(keys.public)
        for export in exports:
            if (error := checks.find_head_error(export)) is not None:
                problems.append(f"the export of agent {export.agent_id} {error}")
            wrong = [error for block in export.blocks() if (error := checks.find_error(block)) is not None]
            if wrong:
                more = f" (and {len(wrong) - 1} blocks more)" if len(wrong) > 1 else ""
                problems.append(f"the export of agent {export.agent_id} holds a block {wrong[0]}{more}")
    return problems, unanchored(exports, keys)


class SignatureChecks:
    """Checks of the signatures in exports. Each signature is verified once."""

    def __init__(self, keys: "PublicKeys", verified: "Callable[[UnverifiedSignature], bool] | None" = None) -> None:
        from ucp.secure.crypto_suite import verify

        self._keys = keys
        self._verified = verified or verify
        self._checked: dict[_Content, str | None] = {}

    def find_error(self, block: ExportedBlock) -> str | None:
        """Return a phrase with the reason why the signature of a block is not valid. Return None if the signature is
        valid.
        """
        claim = block.agent_id, block.timestamp_us, block.event_data, block.block_hash, block.signature
        if claim not in self._checked:
            self._checked[claim] = self._verify(block)
        return self._checked[claim]

    def _verify(self, block: ExportedBlock) -> str | None:
        from ucp.secure.block_signature import block_claim

        public_key = self._keys.vehicles.get(block.agent_id)
        if public_key is None:
            return f"and agent {block.agent_id} has no key in this mission"
        if block.signature is None:
            return "without a signature: it was made or edited without keys"
        data = Block(block.agent_id, block.timestamp_us, block.event_bytes).block_data()
        if not self._verified(block_claim(public_key, self._keys.mission, data, base64.b64decode(block.signature))):
            return f"whose signature does not match the key of agent {block.agent_id}: it was forged or edited"
        return None

    def find_head_error(self, export: Export) -> str | None:
        """Return a phrase with the reason why the signed head of an export is not valid. Return None if the head is
        valid. Also return None for an export without a head, because agents of earlier versions export no head.
        """
        head, public_key = export.head, self._keys.vehicles.get(export.agent_id)
        if head is None:
            return None
        if public_key is None:
            return f"has a head, and agent {export.agent_id} has no key in this mission"
        signed = _head_of(export, head)
        if signed is None or not self._verified(
            signed.claim(public_key, self._keys.mission, base64.b64decode(head.signature))
        ):
            differences = ", ".join(_differences(export, head)) or "the export was forged or edited"
            return f"does not match the head that agent {export.agent_id} signed: {differences}"
        return None


def _head_of(export: Export, head: ExportedHead) -> "ExportHead | None":
    """Return the signed head if it matches the content of the export. Return None if no agent can have signed it."""
    from ucp.secure.export_head import ExportHead, completed_digest, held_digest

    if export.exported_at_us > MAX_U64:
        return None
    return ExportHead(
        export.agent_id,
        bytes.fromhex(head.boot),
        head.number,
        export.exported_at_us,
        len(export.chain),
        bytes.fromhex(export.top_chain_hash),
        completed_digest(map(bytes.fromhex, export.completed)),
        held_digest(
            [bytes.fromhex(block.block_hash) for block in export.blocks_to_be_committed],
            [bytes.fromhex(block.block_hash) for block in export.reconcile_stack],
            base64.b64decode(export.current_block.event_data),
            reconciling=export.reconcile_in_progress,
            idle=export.idle,
        ),
        head.revoked,
    )


def _differences(export: Export, head: ExportedHead) -> Iterator[str]:
    """Yield the differences between the content of an export and the values in its signed head."""
    signed = _head_of(export, head)
    if len(export.chain) != head.height:
        yield f"its chain has {len(export.chain)} blocks, and the head has {head.height}"
    elif export.top_chain_hash != head.top_chain_hash:
        yield "its chain has other blocks, or another order"
    if signed is not None and signed.completed.hex() != head.completed:
        yield "its list `completed` was edited"
    if signed is not None and signed.held.hex() != head.held:
        yield "its deque, reconcile stack, current block or flags were edited"
