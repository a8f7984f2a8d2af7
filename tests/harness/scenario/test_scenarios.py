"""Test that every included scenario has the effect that its first lines describe."""

from collections import Counter
from collections.abc import Callable
from functools import cache
from itertools import combinations
from pathlib import Path

import pytest
import yaml

from harness.checker.recurring_cycles import cycle_of
from harness.checker.survival import survival
from harness.checker.uniform_chain import common_prefix
from harness.run.simulate import Simulated, simulate
from harness.scenario import load_scenario
from harness.scenario.changes import RANGE
from harness.scenario.expect import CHARACTERISTIC_NUMBERS
from tests.harness.command import harness
from ucp.trace import CommandEntry, StateSummary

SCENARIOS = Path(__file__).parents[3] / "scenarios"
MATRIX = SCENARIOS / "thesis_matrix.yaml"
SEEDS = (1, 2, 3)
MAX_UNDECIDED_BLOCKS = 5
"""Maximum number of blocks on which no vote is decided yet at the end of a mission of 20 minutes."""


@cache
def played(name: str, seed: int) -> Simulated:
    return simulate(load_scenario(SCENARIOS / f"{name}.yaml"), seed, tracing=True)


def chains(run: Simulated) -> dict[int, list[str]]:
    """Return the names of the blocks in the chain of each agent, before the final reconcile."""
    exports = run.evidence.before_final_reconcile or run.evidence.exports
    return {agent: [run.evidence.name(it) for it in one.chain_of_block_hashes] for agent, one in exports.items()}


def mutual_length(run: Simulated) -> int:
    return common_prefix(list(chains(run).values()))


def blocks_beyond_mutual(run: Simulated) -> int:
    """Return the length of the longest chain minus the number of blocks that all chains have in common."""
    return max(map(len, chains(run).values())) - mutual_length(run)


def distinct_chains(run: Simulated) -> int:
    return len(set(map(tuple, chains(run).values())))


def copies(run: Simulated) -> Counter[str]:
    """Return the number of chains that contain each block, before the final reconcile."""
    return Counter(block for chain in chains(run).values() for block in chain)


def reconciles(run: Simulated, *agents: int) -> int:
    """Return the number of reconciles of all agents, or of `agents`, before the final reconcile."""
    final = run.played.final_reconcile
    return sum(
        step.branch == "begun" and (final is None or round(step.t, 3) < final.at_s)
        for agent, trace in run.evidence.traces.items()
        for step in trace.runs
        if step.handler == "reconcile_begin" and (not agents or agent in agents)
    )


def state(run: Simulated, agent: int, at_s: float) -> StateSummary:
    """Return the state of the agent just before this mission second."""
    return [step.state for step in run.evidence.traces[agent].runs if step.t < at_s][-1]


def longest_stack(run: Simulated) -> int:
    """Return the greatest length that the reconcile stack of any agent had."""
    return max(step.state.stack for trace in run.evidence.traces.values() for step in trace.runs)


def perfect(run: Simulated, seed: int) -> None:
    assert reconciles(run) == 0
    assert distinct_chains(run) == 1


def missed_commit(run: Simulated, seed: int) -> None:
    assert reconciles(run) > 0
    assert blocks_beyond_mutual(run) <= MAX_UNDECIDED_BLOCKS


def loss_10(run: Simulated, seed: int) -> None:
    assert 0 < reconciles(run) < reconciles(played("loss_15", seed))
    assert blocks_beyond_mutual(run) <= MAX_UNDECIDED_BLOCKS


def loss_15(run: Simulated, seed: int) -> None:
    assert reconciles(run) > 0
    assert blocks_beyond_mutual(run) <= MAX_UNDECIDED_BLOCKS


def loss_25(run: Simulated, seed: int) -> None:
    assert distinct_chains(run) > 1
    assert mutual_length(run) > len(run.evidence.completed_blocks()) / 2
    assert reconciles(run) > reconciles(played("loss_15", seed))


def loss_30(run: Simulated, seed: int) -> None:
    assert distinct_chains(run) > 1
    assert any(common_prefix(list(pair)) > mutual_length(run) for pair in combinations(chains(run).values(), 2))


def loss_50(run: Simulated, seed: int) -> None:
    assert mutual_length(run) < len(run.evidence.completed_blocks()) / 5
    assert distinct_chains(run) == 5
    assert reconciles(run) > len(run.evidence.completed_blocks())


def loss_75(run: Simulated, seed: int) -> None:
    assert mutual_length(run) == 0
    assert list(copies(run).values()).count(1) > 0.8 * len(copies(run))
    assert any(max(copies(played("loss_75", seed)).values()) > 1 for seed in SEEDS)


def loss_100(run: Simulated, seed: int) -> None:
    assert reconciles(run) == 0
    for agent, chain in chains(run).items():
        assert chain == [f"{agent}.{ordinal}" for ordinal in range(1, len(chain) + 1)]
    assert sum(map(len, chains(run).values())) == len(run.evidence.completed_blocks())


def partition_heal(run: Simulated, seed: int) -> None:
    one, other = state(run, 1, 600), state(run, 3, 600)
    assert min(one.chain, other.chain) > 0
    assert one.top != other.top
    assert reconciles(run) > 0
    assert distinct_chains(run) == 1


def rolling_partitions(run: Simulated, seed: int) -> None:
    apart = {200: "12 345", 400: "23 145", 600: "34 125", 800: "45 123", 1000: "15 234"}
    agreed = 0
    for end_s, groups in apart.items():
        two, three = ({state(run, int(agent), end_s).top for agent in group} for group in groups.split())
        assert not two & three
        agreed += (len(two) == 1) + (len(three) == 1)
    assert agreed > len(apart)
    assert reconciles(run) > MAX_UNDECIDED_BLOCKS
    assert distinct_chains(run) == 1


def late_joiner(run: Simulated, seed: int) -> None:
    assert run.played.agents["5"].restarts == 1
    before = state(run, 1, 600).chain
    assert before > 0
    assert reconciles(run, 5) > 0
    assert len(chains(run)[5]) > before
    assert distinct_chains(run) == 1


def shared_channel(run: Simulated, seed: int) -> None:
    channel = run.played.channel
    assert channel is not None
    assert all(count > 100 for count in channel.lost["collision"].values())
    assert len(channel.lost["collision"]) == 20
    assert distinct_chains(run) == 1


def asymmetric_links(run: Simulated, seed: int) -> None:
    unheard, *others = chains(run).values()
    assert all(chain == others[0] for chain in others)
    assert unheard[-1].startswith("1.")
    assert unheard[-1] not in others[0]


def flapping(run: Simulated, seed: int) -> None:
    assert reconciles(run) > 0
    assert distinct_chains(run) == 1


def ordered_twice(run: Simulated, seed: int) -> None:
    for agent in (1, 4):
        runs = [run for run in run.evidence.traces[agent].runs if run.handler == "reconcile_begin"]
        assert [run.branch for run in runs if run.t == 202] == ["already in progress"]


def attrition(run: Simulated, seed: int) -> None:
    losses = survival(run.evidence).losses
    assert [(loss.at_s, loss.what, loss.vehicles) for loss in losses] == [
        (300, "kill", [2]),
        (500, "crash", [4]),
        (750, "reboot", [6]),
    ]
    lives = {agent: (one.outcome, one.restarts, one.reboots) for agent, one in run.played.agents.items()}
    assert (lives["2"], lives["3"], lives["4"]) == (("exported", 1, 0), ("exported", 0, 1), ("killed", 0, 0))
    assert survival(run.evidence).gone < MAX_UNDECIDED_BLOCKS


def forced_tie(run: Simulated, seed: int) -> None:
    assert [step.branch for step in run.evidence.traces[1].runs if step.branch.startswith("tie")]


def large_divergence(run: Simulated, seed: int) -> None:
    assert longest_stack(run) >= 50
    assert distinct_chains(run) == 1


def split_rejoin(run: Simulated, seed: int) -> None:
    assert any(change.what == RANGE for change in run.played.network)
    assert longest_stack(run) > 1
    assert blocks_beyond_mutual(run) <= MAX_UNDECIDED_BLOCKS


def lost_last_commit(run: Simulated, seed: int) -> None:
    without, *others = chains(run)[2], *(chains(run)[agent] for agent in (1, 3, 4, 5))
    assert all(chain == [*without, "4.2"] for chain in others)
    assert reconciles(run) == 0


def in_step(run: Simulated, seed: int) -> None:
    assert livelock(run) == (11.0, 15.0)


def refused_by_the_third(run: Simulated, seed: int) -> None:
    assert livelock(run) == (21.0, 20.0)


def refused_for_ever(run: Simulated, seed: int) -> None:
    assert livelock(run) == (41.0, 20.0)


def three_losses(run: Simulated, seed: int) -> None:
    assert livelock(run) == (42.1, 20.0)


def two_losses(run: Simulated, seed: int) -> None:
    assert livelock(run) == (48.0, 20.5)


def in_resonance(run: Simulated, seed: int) -> None:
    assert livelock(run) == (37.6, 26.0)


def drawn_in(run: Simulated, seed: int) -> None:
    assert livelock(run) == (71.06, 25.0)


def by_turns(run: Simulated, seed: int) -> None:
    assert livelock(run) == (26.011, 30.0)


def livelock(run: Simulated) -> tuple[float, float | None]:
    """Return the mission second at which the cycle began, and its period in seconds."""
    assert run.result.bad == ("5", "6", "liveness")
    cycle = run.evidence.cached(cycle_of)
    assert cycle is not None and cycle.proven
    assert run.played.mission_s < 400
    return cycle.since_s, cycle.period_s


def rogue(run: Simulated, seed: int) -> None:
    violated = {number: one for number, one in run.result.characteristics.items() if one.verdict == "violated"}
    assert set(violated) == {"1", "4"}
    assert {finding.agent_id for finding in violated["4"].evidence} == {1, 2, 3, 4, 5}
    (forged,) = {finding.block for finding in violated["4"].evidence}
    assert forged not in map(run.evidence.name, run.evidence.completed_blocks())
    at_600_s = (
        f"holds block {forged}, which agent 2 never completed; the block arrived at t=600.026 s, in "
        "receive_commit_block"
    )
    assert [finding.detail for finding in violated["4"].evidence if finding.agent_id != 2] == [at_600_s] * 4
    assert all("Commit Block" in finding.detail for finding in violated["1"].evidence)
    assert all("which agent 2 never sent" in finding.detail for finding in violated["1"].evidence)
    again = [step for trace in run.evidence.traces.values() for step in trace.runs if round(step.t, 3) == 300.026]
    assert len(again) == 3 * 4
    assert {(step.trigger.subject, step.branch) for step in again} == {("Commit Block", "does not succeed")}


def field_test_2020(run: Simulated, seed: int) -> None:
    """Check the facts in Section 4.3 and Figure 4.7 of the thesis, including both of its errors and the listed
    differences.
    """
    whole = chains(run)[10]
    assert chains(run)[28] == whole
    for agent in (32, 122):
        truncated = chains(run)[agent]
        assert truncated == whole[: len(truncated)] and len(truncated) < 0.4 * len(whole)
    aligned = common_prefix([whole, chains(run)[118], chains(run)[120]])
    assert 0.6 * len(whole) < aligned < 0.8 * len(whole)
    assert whole[aligned] == "10.9" and "10.8" in whole[:aligned], "not the block of Figure 4.7"
    assert [chains(run)[agent][aligned:] for agent in (118, 120)] == [["118.9"], []]
    exports = run.evidence.exports
    left = {agent: (len(it.blocks_to_be_committed), len(it.reconcile_stack)) for agent, it in exports.items()}
    assert left == {10: (0, 0), 28: (0, 0), 32: (1, 1), 118: (0, 0), 120: (1, 0), 122: (1, 0)}
    assert not any("partition" in change.what for change in run.played.network), "the flight had no partition"
    assert run.evidence.switched_off == {118: 1740, 120: 1740, 122: 1740, 28: 1770, 32: 1770, 10: 1785}
    last_event_s = {
        agent: max(step.t for step in trace.runs if step.trigger.kind == "event")
        for agent, trace in run.evidence.traces.items()
    }
    assert last_event_s[122] < 360 < last_event_s[120] < 860 < last_event_s[10] < 1575
    steps = {(finding.agent_id, finding.handler) for finding in run.result.beside["steps"].evidence}
    assert steps == {
        (32, "reconcile_phase_2_timer_expiration"),
        (118, "reconcile_phase_3"),
        (120, "reconcile_phase_3"),
        (122, "reconcile_phase_2_timer_expiration"),
    }


def captured(run: Simulated, seed: int) -> None:
    """Check that the attacker with the keys of vehicle 3 can forge messages only in the name of vehicle 3."""
    violated = {number: one for number, one in run.result.characteristics.items() if one.verdict == "violated"}
    assert set(violated) == {"1", "4"}
    assert {finding.agent_id for finding in violated["4"].evidence} == {1, 2, 4, 5}
    never_made = (
        "holds block 3.1, which agent 3 never completed, although the block is signed with its key, so its "
        "key is known to others"
    )
    assert all(finding.detail.startswith(never_made) for finding in violated["4"].evidence)
    unsigned = {"not signed by its sender": 1}
    dropped = {agent_id for agent_id, agent in run.played.agents.items() if agent.dropped == unsigned}
    assert dropped == {"1", "4", "5"}, "agents that receive a block in the name of vehicle 2 drop it"


def secure(run: Simulated, seed: int) -> None:
    """Check that agents accept no message of a rogue node without keys."""
    dropped = sum((Counter(agent.dropped) for agent in run.played.agents.values()), Counter[str]())
    assert dropped["replayed"]
    assert dropped["not secured"]
    final = run.evidence.exports.values()
    assert len({export.chain[-1].chain_hash for export in final}) == 1


def revoked_in_partition(run: Simulated, seed: int) -> None:
    """Check that all running agents learn of the excluded vehicle, and that they inform agents that start later."""
    heard_s = {}
    for agent_id, trace in run.evidence.traces.items():
        heard = [aside.t for _, aside in trace.asides if isinstance(aside, CommandEntry) and aside.command == "revoke"]
        if heard:
            heard_s[agent_id] = heard[-1]
    assert heard_s.keys() == {1, 2, 4, 5}
    assert heard_s[1] == heard_s[2] == 350
    assert heard_s[4] > 600
    assert heard_s[5] > 800


CLAIMS: dict[str, Callable[[Simulated, int], None]] = {
    claim.__name__: claim
    for claim in (
        perfect,
        missed_commit,
        loss_10,
        loss_15,
        loss_25,
        loss_30,
        loss_50,
        loss_75,
        loss_100,
        partition_heal,
        rolling_partitions,
        late_joiner,
        asymmetric_links,
        flapping,
        ordered_twice,
        shared_channel,
        attrition,
        forced_tie,
        large_divergence,
        split_rejoin,
        lost_last_commit,
        in_step,
        refused_by_the_third,
        refused_for_ever,
        three_losses,
        two_losses,
        in_resonance,
        drawn_in,
        by_turns,
        rogue,
        captured,
        secure,
        revoked_in_partition,
        field_test_2020,
    )
}
SEEDS_OF = {"field_test_2020": (339,), "captured": (1,)}
PLAYED = [(name, seed) for name in CLAIMS for seed in SEEDS_OF.get(name, SEEDS)]
"""Each scenario with each seed for which its description holds."""


LIVELOCKS = (
    "in_step",
    "refused_by_the_third",
    "refused_for_ever",
    "three_losses",
    "two_losses",
    "in_resonance",
    "drawn_in",
    "by_turns",
)
BAD = ("rogue", "captured", *LIVELOCKS, "missed_commit", "field_test_2020")

WITH_FINAL_RECONCILE = [
    name
    for name in CLAIMS
    if name not in ("rogue", "captured") and load_scenario(SCENARIOS / f"{name}.yaml").final_reconcile
]


def test_every_library_scenario_has_a_claim() -> None:
    assert {path.stem for path in SCENARIOS.glob("*.yaml") if not path.stem.endswith("_matrix")} == set(CLAIMS)


@pytest.mark.parametrize(("name", "seed"), PLAYED)
def test_run_of_a_library_scenario_shows_its_claim(name: str, seed: int) -> None:
    run = played(name, seed)
    assert run.played.settled == (name not in LIVELOCKS)
    assert bool(run.result.bad) == (name in BAD)
    assert not run.played.unmatched_fates
    CLAIMS[name](run, seed)


@pytest.mark.parametrize(("name", "seed"), PLAYED)
def test_run_of_a_library_scenario_meets_its_expectations(name: str, seed: int) -> None:
    run, expect = played(name, seed), load_scenario(SCENARIOS / f"{name}.yaml").expect
    assert expect is not None
    assert set(expect.characteristics) == set(CHARACTERISTIC_NUMBERS.values())
    assert expect.figures
    for number, found in run.result.characteristics.items():
        assert expect.as_expected(number, found.verdict)
    assert expect.as_expected("liveness", run.result.beside["liveness"].verdict)
    assert not list(expect.out_of_range(run.result.figures))
    assert not list(expect.unexpected_common_blocks(run.result.chains))
    steps = run.result.beside["steps"].evidence
    assert not list(expect.unexpected_deviations((finding.agent_id, finding.handler) for finding in steps))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", WITH_FINAL_RECONCILE)
def test_final_reconcile_makes_one_chain_of_all_surviving_blocks(name: str, seed: int) -> None:
    run = played(name, seed)
    assert run.result.figures["distinct_chains"] == 1
    assert run.result.figures["mutual_chain"] == len(run.evidence.completed_blocks()) - survival(run.evidence).gone
    assert {one.verdict for one in run.result.characteristics.values()} == {"holds"}


def test_library_has_a_scenario_for_every_loss_rate_of_the_thesis() -> None:
    lossy = {path.stem: load_scenario(path).network.loss for path in SCENARIOS.glob("loss_*.yaml")}
    assert lossy == {f"loss_{rate * 100:.0f}": rate for rate in yaml.safe_load(MATRIX.read_text())["loss"] if rate}


def test_library_scenario_loads_by_name_from_any_directory(tmp_path: Path) -> None:
    listed = harness("scenarios", cwd=tmp_path).stdout
    for path in SCENARIOS.glob("*.yaml"):
        assert path.stem in listed
    assert load_scenario(Path("loss_15")) == load_scenario(SCENARIOS / "loss_15.yaml")


def test_file_takes_precedence_over_a_library_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "loss_15").write_text("name: mine")
    monkeypatch.chdir(tmp_path)
    assert load_scenario(Path("loss_15")).name == "mine"
