"""Check characteristic 2: an idle agent has committed every block that it completed."""

from harness.checker.evidence import Evidence
from harness.checker.judgement import Finding, Judgement, agents, violated

NAME = "idle implies committed"


def check(evidence: Evidence) -> Judgement:
    """Return the verdict on characteristic 2. The check examines the state of each agent after each handler run, and in
    its export. The verdict is `not applicable` if an agent left no export, or was not idle when it wrote its export.
    """
    findings = [*_check_exports(evidence), *_check_traces(evidence)]
    if findings:
        return violated(NAME, "an idle agent held a completed block that was not in its chain", findings)
    if not evidence.exports:
        return Judgement(NAME, "not applicable", "the run has no chain exports")
    busy = [agent_id for agent_id, export in evidence.exports.items() if not export.idle]
    if busy:
        return Judgement(
            NAME, "not applicable", f"{agents(busy)} {'was' if len(busy) == 1 else 'were'} not idle at the end"
        )
    if evidence.missing:
        return Judgement(NAME, "not applicable", f"the export of {agents(evidence.missing)} is missing")
    if unknown := evidence.describe_unknown_name("operation"):
        return Judgement(NAME, "not applicable", unknown)
    looked = "at the end and after every traced step" if evidence.traces else "at the end"
    blocks = sum(len(export.completed) for export in evidence.exports.values())
    return Judgement(NAME, "holds", f"all {blocks} completed blocks are in their agents' chains, {looked}")


def _check_exports(evidence: Evidence) -> list[Finding]:
    findings = []
    for agent_id, export in evidence.exports.items():
        if not export.idle:
            continue
        in_chain = set(export.chain_of_block_hashes)
        missing = [block_hash for block_hash in export.completed if block_hash not in in_chain]
        aside = [block.block_hash for block in (*export.blocks_to_be_committed, *export.reconcile_stack)]
        for block_hash in dict.fromkeys((*missing, *aside)):
            findings.append(
                Finding(
                    agent_id,
                    f"idle at the export, but its completed block {evidence.name(block_hash)} is not in its chain",
                    evidence.name(block_hash),
                    block_hash,
                )
            )
    return findings


def _check_traces(evidence: Evidence) -> list[Finding]:
    findings = []
    for agent_id, incarnations in evidence.incarnations.items():
        for incarnation in incarnations:
            for observation in incarnation.idle_too_early:
                waiting, run = observation.block_hash, observation.run
                detail = (
                    f"trace line {observation.line}, t={run.t:g} s: idle after {run.handler} with {observation.what}"
                )
                findings.append(Finding(agent_id, detail, evidence.name(waiting) if waiting else None, waiting))
    return findings
