"""Print the result of a proof. The text says "holds" about a property only if all states were explored."""

from collections.abc import Iterator

from harness.proof._proof import PLAYED, Proof
from harness.proof.bounds import Bounds
from harness.proof.examples._example import ViolationExample

WHY = {
    "flaw": "the search stopped at the first flaw",
    "memory": "the bound of --memory was reached",
    "time": "the bound of --for was reached",
    "interrupted": "it was interrupted",
}


def in_words(proof: Proof) -> Iterator[str]:
    figures = proof.figures
    ended = "complete" if proof.complete else f"not complete: {WHY[proof.ended]}"
    yield f"{proof.bounds.in_words()}: {ended}"
    left = "" if proof.complete else f", {figures.looked_at:,} of them explored"
    instants = "of single agents" if figures.depth is None else f"up to {figures.depth} instants"
    yield (
        f"  {figures.states:,} states{left}, {figures.transitions:,} transitions, {figures.local_states:,} "
        f"local states, {figures.zones:,} zones, {instants}, in {figures.seconds:.1f} s"
    )
    if proof.ended in ("memory", "time") and (tighter := _tighter(proof.bounds)):
        yield f"  a smaller state space: the same bounds with {' or '.join(tighter)}"
    for kind, claim in proof.claims.items():
        yield f"{_mark(proof, kind)} {_name(kind)}: {claim}"
        if (shown := proof.shown.get(kind)) is not None:
            yield f"    the nearest, {shown.instants} instants: {shown.replay}"
            yield from _played(shown)
    if proof.flaw is not None:
        yield f"    {proof.flaw.sentence}"
    yield from _of_the_whole(proof)
    if proof.way:
        yield f"  path of one agent, if one run can send all its received messages: {'; '.join(proof.way)}"
    for livelock in proof.livelocks:
        cycles = f"{livelock.ways} cycle{'s' if livelock.ways > 1 else ''}"
        yield f"  {cycles} of one form, {livelock.in_words()}: {livelock.example.replay}"
        yield from _played(livelock.example)
    live = proof.liveness
    if live is not None and (more := len(live.cycles) - sum(livelock.ways for livelock in proof.livelocks)):
        yield f"  {more} more, of other forms, {'was' if more == 1 else 'were'} not played"
    example = proof.example
    if example is not None and not proof.livelocks:
        yield f"  a shortest path to it, {example.instants} instants: {example.replay}"
        if proof.flaw is not None and PLAYED[proof.flaw.kind] not in example.judged:
            yield "    not confirmed: the simulation takes another path"
        if proof.flaw is None and not example.judged:
            yield "    played: a run cannot show that no path leads to one chain"
        else:
            yield from _played(example)


def _tighter(bounds: Bounds) -> list[str]:
    """Return command options that reduce the number of states. They are suggested after a proof that reached a
    limit.
    """
    if bounds.network == "any" or bounds.timers_any:
        return []
    options = ["--losses 1"] if bounds.network == "lossy" and bounds.losses is None else []
    options += ["--coincidences 0"] if bounds.coincidences is None else []
    options += ["--no-crossing"] if bounds.crossing else []
    if bounds.nameless and not bounds.clocks_any:
        options.append("--clocks any")
    options += [] if bounds.zones_contained else ["--zones contained"]
    return options


def _played(example: ViolationExample) -> Iterator[str]:
    for key, judgement in example.judged.items():
        yield f"    played: {key} {judgement.verdict}, {judgement.reason}"
    if not example.judged:
        yield "    played: the simulation takes another path in the end and shows no violation"


def _name(kind: str) -> str:
    return f"characteristic {kind}" if kind.isdecimal() else kind


def _mark(proof: Proof, kind: str) -> str:
    if kind in proof.shown:
        return "✘ violated,"
    if proof.flaw is not None and proof.flaw.kind == kind:
        return "✘ not shown," if proof.bounds.network == "any" and proof.example is None else "✘ violated,"
    return "✔ holds," if proof.complete else "- not decided,"


def _of_the_whole(proof: Proof) -> Iterator[str]:
    live = proof.liveness
    if proof.bounds.network == "any":
        yield "- not checked, one chain, livelock: they need the states of all agents together: use --network lossy"
        return
    if live is None:
        if proof.whole_ended != "complete":
            yield f"  the whole graph is not complete: {WHY[proof.whole_ended]}"
        yield (
            "- not decided, one chain: from every state some path without losses leads to an idle swarm with one chain"
        )
        if proof.livelocks:
            yield "✘ violated, livelock: the explored states have cycles without losses that never end"
        else:
            yield "- not decided, livelock: no cycle lasts for ever"
        return
    votes = len(live.astray) - 1
    after = (
        "without another vote" if not votes else "after one more vote" if votes == 1 else f"after {votes} more votes"
    )
    if not live.decided:
        yield "- not decided, one chain: the states after more votes exceed the limit of the search"
    elif proof.left_open:
        yield (
            f"- not decided, one chain: {live.astray[-1]:,} states have no path without losses to an idle swarm with "
            f"one chain, even {after}, or they represent states that have one: use --zones equal"
        )
    elif live.lost is None:
        yield (
            "✔ holds, one chain: from every state some path without losses leads to an idle swarm with one chain, "
            f"{after}"
        )
    else:
        states = f"{live.astray[-1]:,} states"
        yield (
            f"✘ not shown, one chain: from {states} no path without losses leads to an idle swarm with one chain, "
            f"even {after}"
        )
        if live.flaw is not None:
            yield f"    after further votes a violation ended a path: {live.flaw.sentence}"
    if votes and live.decided:
        counts = ", ".join(f"{count:,} with {number}" for number, count in enumerate(live.astray[:-1]))
        yield f"    states without such a path, by number of further votes: {counts}"
    if proof.reluctant is not None:
        nearest = proof.reluctant
        yield f"    the nearest that needs more than one vote, {nearest.instants} instants: {nearest.replay}"
    yield f"    {live.forks:,} states are idle with several chains, and stay idle until an agent starts a vote"
    if proof.fork is not None:
        fork = proof.fork
        yield (
            f"    the nearest of them, {fork.instants} instants, {fork.chains} chains in the simulation: {fork.replay}"
        )
    if live.cycles:
        count = len(live.cycles)
        cycles = (
            "is 1 cycle without losses that lasts" if count == 1 else f"are {count} cycles without losses that last"
        )
        yield f"✘ violated, livelock: there {cycles} for ever"
    else:
        yield "✔ holds, livelock: without losses and new blocks no cycle lasts for ever"
