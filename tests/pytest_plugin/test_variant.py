"""Test how tests select protocol variants: by a mark, or by an option for the session."""

from pathlib import Path

import pytest

from harness.play.variant import variant_in_use
from tests.pytest_plugin.inner import no_internals, run, write_scenario

pytest_plugins = "pytester"

ANSWERS = """
from harness.play.variant import of_core, of_reference
from ucp.messages import ChainContainResponse


@of_core(9)
def answer_always(core, sender, message):
    contained = core.chain.contains_chain_hash(message.chain_hash)
    core.send(ChainContainResponse(message.chain_hash, contained))
    return "yes" if contained else "no"


@of_reference(9)
def answers_always(state, sender, message):
    contained = state.chain.contains_chain_hash(message.chain_hash)
    state.send(ChainContainResponse(message.chain_hash, contained))
    return "yes" if contained else "no"
"""
NAMED = 'assert json.loads((run.directory / "run.json").read_text())["versions"]["variant"].startswith("answers ")'


@pytest.fixture(autouse=True)
def variants(pytester: pytest.Pytester) -> Path:
    """Write a variant, and a file in which agents and checker follow different variants."""
    (pytester.path / "answers.py").write_text(ANSWERS)
    (pytester.path / "differs.py").write_text(
        ANSWERS.replace(
            "ChainContainResponse(message.chain_hash, contained)",
            "ChainContainResponse(message.chain_hash, not contained)",
            1,
        )
    )
    return pytester.path


def test_marks_put_a_variant_in_force(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "s.yaml")
    pytester.makepyfile(f"""
    import json, pytest

    @pytest.mark.scenario("s.yaml", variant="answers.py")
    def test_scenario(scenario):
        run = scenario
        {NAMED}

    @pytest.mark.swarm(agents=2, variant="answers.py")
    def test_swarm(swarm):
        swarm.reconcile(1)
        swarm.run_for(10)
        assert swarm.judgement("steps").verdict == "as specified"

    def test_next(swarm):
        from harness.play.variant import variant_in_use
        assert variant_in_use() is None
    """)
    run(pytester).assert_outcomes(passed=3)
    assert variant_in_use() is None


def test_option_puts_a_variant_in_force_and_a_failure_names_it(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "s.yaml", expect={}, timeline=[{"at_s": 50, "reconcile": [1]}])
    result = run(pytester, "s.yaml", "--ucp-variant", "differs.py")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "steps: deviates: *receive_request_chain_contain",
            f"again, with seed 1: * --variant {pytester.path}/differs.py",
        ]
    )


@pytest.mark.parametrize(
    ("marked", "sentence"),
    [("3", "`variant` is 3: use the path of a Python file"), ('"none.py"', "*none.py: cannot be read: No such file*")],
)
def test_unusable_variant_is_reported_in_one_sentence(pytester: pytest.Pytester, marked: str, sentence: str) -> None:
    pytester.makepyfile(f"import pytest\n@pytest.mark.swarm(variant={marked})\ndef test_mistake(swarm): pass")
    result = run(pytester)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([sentence])
    no_internals(result)
