"""Test protocol variants: agents follow a variant, the checker judges the agents by the variant, and records name the
variant.
"""

import json
import sys
from pathlib import Path

import pytest

from harness.checker import check
from harness.play.process._agent_process import agent_command
from harness.play.variant import VariantError, load_variant, variant_in_use
from harness.run.simulate import simulate
from harness.run.variant_in_force import in_force
from tests.harness.command import harness, sentences
from tests.harness.play.test_simulation import digest
from tests.harness.virtual import scenario

HEAD = "from harness.play.variant import of_core, of_reference\n"
CORE = """
@of_core(11)
def pops_on_tie(core):
    yes, no = core.reconcile_vote_count["yes"], core.reconcile_vote_count["no"]
    if yes + no == 0:
        core.trigger("Reconcile Finalize")
        return "no response"
    if yes <= no:
        if not len(core.chain):
            core.trigger("Reconcile Finalize")
            return "at inception"
        core.pop_to_stack()
        core.trigger("Reconcile Phase 1")
        return "not contained"
    core.trigger("Reconcile Phase 2")
    return "contained"
"""
REFERENCE = """
@of_reference(11)
def tie_pops(state):
    yes, no = state.reconcile_vote_count["yes"], state.reconcile_vote_count["no"]
    if yes + no == 0:
        state.trigger("Reconcile Finalize")
        return "no response"
    if yes > no:
        state.trigger("Reconcile Phase 2")
        return "contained"
    if len(state.chain) == 0:
        state.trigger("Reconcile Finalize")
        return "at inception"
    block = state.chain.pop()
    state.changed("chain-", block)
    state.push_stack(block)
    state.trigger("Reconcile Phase 1")
    return "not contained"
"""
LOSSY = {"agents": 5, "duration_s": 600.0, "network": {"loss": 0.3}}
"""Keys of a scenario in which ties of phase 1 occur."""
NEW_BRANCH = """
@of_core(6, branches=("refused",))
def refuse(core, sender, message):
    return "refused"


@of_reference(6)
def refuses(state, sender, message):
    return "refused"
"""


@pytest.fixture
def pop_variant(tmp_path: Path) -> Path:
    """Return the path of a variant with the same behaviour as the setting `phase1_tie: pop`."""
    return write_variant(tmp_path, HEAD + CORE + REFERENCE)


def write_variant(directory: Path, text: str) -> Path:
    path = directory / "pops.py"
    path.write_text(text)
    return path


def test_variant_of_a_setting_plays_as_the_setting(pop_variant: Path) -> None:
    original = digest(simulate(scenario(**LOSSY), 1, tracing=True, deliver_all=True))
    with in_force(pop_variant):
        variant = simulate(scenario(**LOSSY), 1, tracing=True)
    setting = simulate(scenario(**LOSSY, settings={"phase1_tie": "pop"}), 1, tracing=True, deliver_all=True)
    assert [run.branch for trace in variant.evidence.traces.values() for run in trace.runs] == [
        run.branch for trace in setting.evidence.traces.values() for run in trace.runs
    ]
    assert digest(variant) != original, "the mission has a tie"
    assert variant.result.beside["steps"].verdict == "as specified"
    assert digest(simulate(scenario(**LOSSY), 1, tracing=True, deliver_all=True)) == original
    assert variant_in_use() is None


def test_judge_names_the_handler_if_the_transcriptions_differ(tmp_path: Path) -> None:
    wrong = write_variant(tmp_path, HEAD + CORE.replace("yes <= no", "yes < no") + REFERENCE)
    with in_force(wrong):
        result = simulate(scenario(**LOSSY), 1, tracing=True).result
    assert result.beside["steps"].verdict == "deviates"
    assert "Algorithm 11" in result.beside["steps"].reason


def test_original_judge_finds_a_run_of_the_variant(pop_variant: Path) -> None:
    with in_force(pop_variant):
        run = simulate(scenario(**LOSSY), 1, tracing=True)
    assert check(run.evidence).beside["steps"].verdict == "deviates"


def test_new_branch_of_a_variant_is_a_known_word(tmp_path: Path) -> None:
    with in_force(write_variant(tmp_path, HEAD + NEW_BRANCH)):
        result = simulate(scenario(agents=3, duration_s=200.0), 1, tracing=True).result
    assert result.beside["steps"].verdict == "as specified"


def test_run_is_judged_only_with_the_variant_that_made_it(pop_variant: Path, tmp_path: Path) -> None:
    def run(out: str, *options: object) -> None:
        done = harness("run", "loss_30", "--backend", "sim", "--seed", 1, "--out", tmp_path / out, *options)
        assert done.returncode == 0, done.stdout + done.stderr

    run("changed", "--variant", pop_variant)
    run("original")
    versions = json.loads((tmp_path / "changed" / "run.json").read_text())["versions"]
    assert versions["variant"] == load_variant(pop_variant).version
    assert harness("check", tmp_path / "changed", "--variant", pop_variant).returncode == 0
    other = tmp_path / "other"
    other.mkdir()
    write_variant(other, pop_variant.read_text() + "# edited\n")
    for command in (("check",), ("replay", "--agent", 1)):
        for options, why in (
            ((tmp_path / "changed",), "was made with the variant pops"),
            ((tmp_path / "changed", "--variant", other / "pops.py"), "not with pops"),
            ((tmp_path / "original", "--variant", pop_variant), "was made without a variant: leave out --variant"),
        ):
            done = harness(command[0], *options, *command[1:])
            assert done.returncode == 2, (command, options, done.stdout)
            assert why in sentences(done.stderr)[-1]


def test_agent_process_runs_with_the_variant(pop_variant: Path) -> None:
    with in_force(pop_variant):
        assert agent_command(scenario(), 1)[-2:] == ["harness.play.variant_agent", str(pop_variant)]
    assert agent_command(scenario(), 1)[-1] == "ucp.node"


def test_conformance_expects_the_variant(pop_variant: Path, tmp_path: Path) -> None:
    agent = (sys.executable, "-m", "harness.play.variant_agent", pop_variant)
    asked = ("conformance", "--virtual", "--only", 11, "--variant", pop_variant, "--keep", tmp_path / "kept")
    done = harness(*asked, "--", *agent)
    assert done.returncode == 0, done.stdout


def test_proof_of_a_variant_does_not_reduce_states(pop_variant: Path, tmp_path: Path) -> None:
    bounds = ("--agents", 2, "--blocks", 2, "--losses", 1, "--steps")
    done = harness("prove", *bounds, "--variant", pop_variant, "--json", "--out", tmp_path / "found.yaml")
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["reduced"] is False
    assert "the variant is pops (Algorithm 11)" in done.stderr


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "the variant changes nothing; declare a handler with of_core"),
        (HEAD + CORE, "Algorithm 11 has a function with of_core and none with of_reference; add one"),
        (HEAD + CORE + CORE.replace("pops_on_tie", "again") + REFERENCE, "two functions change Algorithm 11"),
        (HEAD + CORE.replace("11", "21") + REFERENCE, r"there is no Algorithm 21; name one of 1\.\.20"),
        ("import nothing_like_this", "the variant cannot be loaded: ModuleNotFoundError"),
        ("def", "the variant cannot be loaded: SyntaxError"),
    ],
)
def test_unusable_variant_is_refused_in_a_sentence(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(VariantError, match=why):
        load_variant(write_variant(tmp_path, text))


def test_missing_variant_is_refused_in_a_sentence(tmp_path: Path) -> None:
    done = harness("run", "loss_30", "--variant", tmp_path / "none.py", "--out", tmp_path / "run")
    assert done.returncode == 2
    assert sentences(done.stderr) == [f"{tmp_path / 'none.py'}: cannot be read: No such file or directory"]
