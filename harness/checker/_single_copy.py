"""Check characteristic 3: an agent holds at most one copy of a block in its chain, deque and reconcile stack."""

from collections import Counter

from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding, Judgement, agents, violated

NAME = "single copy"


def check(evidence: Evidence) -> Judgement:
    """Check the exports, and the state after each line of the traces. Return the verdict on characteristic 3. The
    verdict is `not applicable` if an export is missing.
    """
    findings: list[Finding] = []
    for agent_id, export in evidence.exports.items():
        copies = Counter(block.block_hash for block in export.blocks())
        for block_hash, count in copies.items():
            if count > 1:
                name = evidence.name(block_hash)
                findings.append(Finding(agent_id, f"exported {count} copies of block {name}", name, block_hash))
    for agent_id, incarnations in evidence.incarnations.items():
        for incarnation in incarnations:
            for sight in incarnation.second_copies:
                name = evidence.name(sight.block_hash or "")
                detail = f"{sight.where}: a second copy of block {name}"
                findings.append(Finding(agent_id, detail, name, sight.block_hash))
    if findings:
        return violated(NAME, "an agent held a block twice", findings)
    if not evidence.exports:
        return Judgement(NAME, "not applicable", "the run has no chain exports")
    if evidence.missing:
        return Judgement(NAME, "not applicable", f"the export of {agents(evidence.missing)} is missing")
    if unknown := evidence.describe_unknown_name("operation"):
        return Judgement(NAME, "not applicable", unknown)
    looked = " and after every traced step" if evidence.traces else ""
    return Judgement(NAME, "holds", f"no duplicate block in {len(evidence.exports)} exports{looked}")
