"""Check characteristic 4: each block is unchanged, and was completed by the agent that it names."""

import base64
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from harness.archive.exports import Export, ExportedBlock
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding, Judgement, agents, violated
from harness.checker.missing_incarnations import may_be_of_missing_incarnation
from ucp.block import Block, InceptionBlock, next_chain_hash

if TYPE_CHECKING:
    from collections.abc import Callable

    from ucp.secure.bundle import PublicKeys
    from ucp.secure.crypto_suite import SignatureClaim

NAME = "genuine"

_Content = tuple[int, int, str, str]
"""Agent, timestamp, event data and block hash of a block, as exported."""
_Link = tuple[str, str, str | None]
"""The chain hash below a block, its block hash, and its chain hash."""


@dataclass
class _VerifiedHashes:
    """A cache of verified hashes. A block that many agents hold is hashed once."""

    blocks: set[_Content] = field(default_factory=set)
    links: set[_Link] = field(default_factory=set)

    def is_block(self, block: ExportedBlock) -> bool:
        """Return true if the content of the block gives its block hash."""
        content = block.agent_id, block.timestamp_us, block.event_data, block.block_hash
        if content not in self.blocks:
            if Block(block.agent_id, block.timestamp_us, block.event_bytes).block_hash.hex() != block.block_hash:
                return False
            self.blocks.add(content)
        return True

    def is_link(self, link: _Link) -> bool:
        """Return true if the chain hash follows from the previous chain hash and the block hash (eq. 3.2)."""
        if link not in self.links:
            below, block_hash, chain_hash = link
            if next_chain_hash(bytes.fromhex(below), bytes.fromhex(block_hash)).hex() != chain_hash:
                return False
            self.links.add(link)
        return True


class _SignatureChecks:
    """A cache of verified block signatures. Each signature is verified once."""

    def __init__(self, keys: "PublicKeys", verified: "Callable[[SignatureClaim], bool] | None") -> None:
        from ucp.secure.crypto_suite import verify

        self._keys = keys
        self._verified = verified or verify
        self._checked: dict[tuple[_Content, str | None], str | None] = {}

    def find_error(self, block: ExportedBlock) -> str | None:
        """Return the error in the signature of the block, or None if it is valid. The text ends a sentence about
        the block.
        """
        claim = (block.agent_id, block.timestamp_us, block.event_data, block.block_hash), block.signature
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


def check(evidence: Evidence) -> Judgement:
    """Compute the hashes in all exports again, and compare the blocks with those that each agent completed.

    In a secured mission signatures decide, so that the records of the agent that made a block may be missing. A signed
    block that this agent did not complete is not genuine either, because an attacker has its key.

    The result is `not applicable` without an export, or if the blocks that an agent completed are unknown.
    """
    findings: list[Finding] = []
    roster = evidence.roster
    completed = evidence.completed_blocks()
    known = {*evidence.exports, *evidence.traces, *completed.values()} - evidence.injected.outside_senders
    known -= evidence.agents_with_unknown_completed()
    unknown: set[int] = set()
    blocks = 0
    recomputed = _VerifiedHashes()
    signatures = _SignatureChecks(evidence.public_keys, evidence.verified) if evidence.public_keys else None
    for agent_id, export in evidence.exports.items():
        findings += _check_hashes(agent_id, export, evidence, recomputed)
        for block in export.blocks():
            blocks += 1
            on_the_roster = roster is None or block.agent_id in roster
            wrong_signature = signatures.find_error(block) if signatures else None
            if on_the_roster and not wrong_signature and completed.get(block.block_hash) == block.agent_id:
                continue  # most are like this
            name = evidence.name(block.block_hash)
            if not on_the_roster:
                detail = f"holds block {name} of agent {block.agent_id}, which is not on the roster"
            elif wrong_signature:
                detail = f"holds block {name}, {wrong_signature}"
            elif block.agent_id not in known or may_be_of_missing_incarnation(evidence, block):
                if not signatures:
                    unknown.add(block.agent_id)
                continue
            else:
                detail = f"holds block {name}, which agent {block.agent_id} never completed"
                detail += (
                    ", although the block is signed with its key, so its key is known to others" if signatures else ""
                )
                detail += _describe_arrival(evidence.traces.get(agent_id), block.block_hash)
            findings.append(Finding(agent_id, detail, name, block.block_hash))
    for agent_id, export in evidence.before_final_reconcile.items():
        edited = _check_hashes(agent_id, export, evidence, recomputed)
        findings += [replace(finding, detail=f"{finding.detail}, before the final reconcile") for finding in edited]
    if findings:
        return violated(NAME, "a block was not made by an agent of this mission", findings)
    if not evidence.exports:
        return Judgement(NAME, "not applicable", "the run has no chain exports")
    if unknown:
        return Judgement(NAME, "not applicable", _explain_unknown_makers(evidence, unknown))
    made = "signed" if signatures else "completed"
    reason = f"all hashes recompute, and each of {blocks} blocks was {made} by the agent that it names"
    if not signatures and any(block.signature for export in evidence.exports.values() for block in export.blocks()):
        reason += "; the signatures were not checked, because public.json is missing next to the exports"
    return Judgement(NAME, "holds", reason)


def _explain_unknown_makers(evidence: Evidence, unknown: set[int]) -> str:
    if silent := unknown - {*evidence.exports, *evidence.traces}:
        return (
            f"neither an export nor a trace lists the completed blocks of {agents(silent)}, so the makers of their "
            "blocks are unknown"
        )
    problem = next((trace.problem for agent_id in sorted(unknown) if (trace := evidence.traces.get(agent_id))), None)
    why = f" ({problem})" if problem else ""
    return (
        f"the records of {agents(unknown)} do not show all incarnations{why}, so the makers of some blocks are unknown"
    )


def _describe_arrival(trace: Trace | None, block_hash: str) -> str:
    """Return the time and the handler with which an agent received a block. The text ends a sentence."""
    came = ("chain+", block_hash)
    for run in trace.runs if trace else ():
        if came in map(tuple, run.changes):
            return f"; the block arrived at t={run.t:g} s, in {run.handler}"
    return ""


def _check_hashes(agent_id: int, export: Export, evidence: Evidence, recomputed: _VerifiedHashes) -> list[Finding]:
    findings = []
    inception = InceptionBlock(base64.b64decode(export.inception.block_data))
    if (inception.block_hash.hex(), inception.chain_hash.hex()) != (
        export.inception.block_hash,
        export.inception.chain_hash,
    ):
        findings.append(Finding(agent_id, "the inception block's hashes do not recompute: the export was edited"))
    for block in export.blocks():
        if not recomputed.is_block(block):
            name = evidence.name(block.block_hash)
            findings.append(
                Finding(agent_id, f"block {name} does not match its block hash: it was edited", name, block.block_hash)
            )
    below = export.inception.chain_hash
    for block in export.chain:
        if not recomputed.is_link((below, block.block_hash, block.chain_hash)):
            name = evidence.name(block.block_hash)
            findings.append(
                Finding(
                    agent_id,
                    f"the chain hash at block {name} does not match the blocks up to it",
                    name,
                    block.block_hash,
                )
            )
            break  # every chain hash above depends on this one
        below = block.chain_hash or ""
    return findings
