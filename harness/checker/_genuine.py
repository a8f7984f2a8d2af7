"""Check characteristic 4: each block is unchanged, and was completed by the agent whose ID it contains."""

import base64
from dataclasses import dataclass, field, replace

from harness.archive.exports import Export, ExportedBlock
from harness.archive.traces import Trace
from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding, Judgement, agents, violated
from harness.checker.lost_lines import may_be_of_missing_incarnation
from harness.checker.signatures import SignatureChecks, is_older, unanchored
from ucp.block import Block, InceptionBlock, next_chain_hash

NAME = "genuine"

_Content = tuple[int, int, str, str]
"""The content of an exported block: agent, timestamp, event data and block hash."""
_Link = tuple[str, str, str | None]
"""Three hashes: the chain hash of the previous block, the block hash, and the chain hash of the block. The third hash
must follow from the first two (eq. 3.2).
"""


@dataclass
class _VerifiedHashes:
    """A cache of verified hashes. Many agents hold the same block, but the checker computes its hash only once."""

    blocks: set[_Content] = field(default_factory=set)
    links: set[_Link] = field(default_factory=set)

    def is_block(self, block: ExportedBlock) -> bool:
        """Return true if the block hash matches the content of the block."""
        content = block.agent_id, block.timestamp_us, block.event_data, block.block_hash
        if content not in self.blocks:
            if Block(block.agent_id, block.timestamp_us, block.event_bytes).block_hash.hex() != block.block_hash:
                return False
            self.blocks.add(content)
        return True

    def is_link(self, link: _Link) -> bool:
        """Return true if the chain hash matches the previous chain hash and the block hash (eq. 3.2)."""
        if link not in self.links:
            below, block_hash, chain_hash = link
            if next_chain_hash(bytes.fromhex(below), bytes.fromhex(block_hash)).hex() != chain_hash:
                return False
            self.links.add(link)
        return True


def check(evidence: Evidence) -> Judgement:
    """Recompute the hashes in all exports, and compare the exported blocks with the blocks that each agent completed.
    Return the verdict on characteristic 4.

    In a secured mission, agents sign their blocks and exports. The signatures then prove who completed a block, so the
    check does not need the records of the block's author. A signed block that its author did not complete is still not
    genuine, because an attacker may have the author's key. Each export has a signed head, which covers the order and
    the number of its blocks.

    The verdict is `not applicable` without an export, or if the completed blocks of an agent are unknown. In a secured
    mission it is also `not applicable` without an anchor, a trusted copy of the public keys.
    """
    findings: list[Finding] = []
    roster = evidence.roster
    completed = evidence.completed_blocks()
    known = {*evidence.exports, *evidence.traces, *completed.values()} - evidence.injected.outside_senders
    known -= evidence.agents_with_unknown_completed()
    unknown: set[int] = set()
    blocks = 0
    recomputed = _VerifiedHashes()
    signatures = SignatureChecks(evidence.keys.public, evidence.verified) if evidence.keys else None
    for agent_id, export in evidence.exports.items():
        findings += _check_hashes(agent_id, export, evidence, recomputed)
        if signatures and (wrong_head := signatures.find_head_error(export)):
            findings.append(Finding(agent_id, f"its export {wrong_head}"))
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
        if signatures and (wrong_head := signatures.find_head_error(export)):
            edited.append(Finding(agent_id, f"its export {wrong_head}"))
        if (later := evidence.exports.get(agent_id)) and is_older(later, export):
            findings.append(Finding(agent_id, "its export is older than the one from before the final reconcile"))
        findings += [replace(finding, detail=f"{finding.detail}, before the final reconcile") for finding in edited]
    if findings:
        return violated(NAME, "a block or an export is not as an agent of this mission made it", findings)
    if not evidence.exports:
        return Judgement(NAME, "not applicable", "the run has no chain exports")
    if unknown:
        return Judgement(NAME, "not applicable", _explain_unknown_makers(evidence, unknown))
    made = "signed" if signatures else "completed"
    reason = f"all hashes recompute, and each of {blocks} blocks was {made} by the agent that it names"
    if not evidence.secured:
        return Judgement(NAME, "holds", reason)
    if doubt := unanchored(evidence.exports.values(), evidence.keys):
        return Judgement(NAME, "not applicable", doubt)
    assert evidence.keys is not None, "unanchored exports have a reason"
    return Judgement(NAME, "holds", f"{reason}, with the public keys that {evidence.keys.anchor} names")


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
    """Return when an agent received a block, and which handler processed it. The text is the end of a sentence, such as
    "; the block arrived at t=7 s, in receive_commit_block". It is empty if the trace does not show this.
    """
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
