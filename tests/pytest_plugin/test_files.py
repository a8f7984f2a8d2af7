"""Test that the plugin collects scenarios as tests, and ignores YAML files of other programs."""

import json
import os
import shlex
import sys

import pytest
import yaml

from tests.pytest_plugin.inner import SCENARIOS, no_internals, report, run, run_directories, write_scenario

pytest_plugins = "pytester"


def collected(pytester: pytest.Pytester, *arguments: object) -> list[str]:
    result = run(pytester, "--collect-only", "-q", *arguments)
    return [line for line in result.outlines if "::" in line]


def test_file_becomes_a_test_for_each_backend_and_seed(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "loss.yaml", expect={"backends": ["sim", "process"], "seeds": [1, 7]})
    assert collected(pytester, "loss.yaml") == [
        f"loss.yaml::{name}" for name in ("sim-seed1", "sim-seed7", "process-seed1", "process-seed7")
    ]
    assert collected(pytester, "loss.yaml::sim-seed7") == ["loss.yaml::sim-seed7"]
    assert collected(pytester, "loss.yaml", "--ucp-backend", "sim", "--ucp-seed", 3) == ["loss.yaml::sim-seed3"]


def test_selected_file_with_expectations_is_a_test(
    pytester: pytest.Pytester,
) -> None:
    for folder in ("a", "b"):
        pytester.mkdir(folder)
        write_scenario(pytester, f"{folder}/yes.yaml", expect={})
        write_scenario(pytester, f"{folder}/no.yaml")
    assert collected(pytester) == []
    everything = ["a/yes.yaml::sim-seed1", "b/yes.yaml::sim-seed1"]
    assert collected(pytester, ".") == collected(pytester, pytester.path) == everything
    assert collected(pytester, "a/no.yaml") == []
    assert collected(pytester, "a") == collected(pytester, "a/yes.yaml") == ["a/yes.yaml::sim-seed1"]
    pytester.makeini("[pytest]\ntestpaths = b")
    assert collected(pytester) == ["b/yes.yaml::sim-seed1"]
    assert collected(pytester, ".") == everything


def test_run_as_expected_passes_and_leaves_nothing(pytester: pytest.Pytester) -> None:
    text = (
        "name: x\n# expect: nothing\nduration_s: 100\nexpect:\n  # as usual\n  seeds: [1, 2]\nvehicles:\n  kind: none\n"
    )
    (pytester.path / "s.yml").write_text(text)
    run(pytester, "s.yml").assert_outcomes(passed=2)
    assert not run_directories(pytester)


def test_violation_is_reported_with_evidence_and_report_path(pytester: pytest.Pytester) -> None:
    scenario = yaml.safe_load((SCENARIOS / "forced_tie.yaml").read_text())
    scenario |= {"quirks": {"crash_on_tie": True}, "expect": {}}
    write_scenario(pytester, "tie.yaml", **scenario)
    scenario["expect"] = {"characteristics": {1: "violated", 5: "holds"}}
    write_scenario(pytester, "expected.yaml", **scenario)
    result = run(pytester, "tie.yaml", "expected.yaml")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(
        [
            "*_ tie.yaml::sim-seed1 _*",
            "characteristic 1, distributed: violated: *",
            "    agent 1: *a reconcile did not continue within*",
            "steps: deviates: 1 difference in *",
            "    agent 1: *Algorithm 15, reconcile_phase_2_timer_expiration: it took the branch 'crashed by *",
            "liveness: never finishes: agent 1 has hung since 42 s: not idle, and no running timer can change this",
            "deliberate mistakes: crash_on_tie (all agents)",
            "report: *",
            "*_ expected.yaml::sim-seed1 _*",
            "characteristic 5, all committed everywhere: violated: the system is fully connected, but agent 1 has hung "
            "since 42 s",
            "    expected: holds",
        ]
    )
    no_internals(result)
    report(result)


@pytest.mark.parametrize(
    ("expect", "sentence"),
    [
        ({"characteristics": {7: "holds"}}, "*no characteristic '7': use 1 to 6"),
        ({"characteristics": {6: "hold"}}, "*is 'hold': it should be 'holds', 'violated' or *; did you mean `holds`?"),
        ({"figures": {"block": 1}}, "*no figure 'block': use one of agents, blocks, *"),
        ({"figures": {"blocks": "many"}}, "*is 'many': it should be a number, or {min: number, max: number}"),
        ({"figures": {"blocks": {"min": 3, "max": 2}}}, "*min 3 is more than max 2"),
        ({"seeds": [1, 1]}, "*`expect.seeds` is *: names one expectation twice: leave out one of them"),
        ({"backends": ["kernel"]}, "*`expect.backends.0` is 'kernel': it should be 'process', 'docker' or 'sim'"),
        ({"characterstics": {1: "holds"}}, "*`expect.characterstics` is unknown: use one of characteristics, *"),
        (
            {"seed": [1], "figures": {}},
            "*`expect.seed` is unknown: use one of characteristics, steps, *",
        ),
    ],
)
def test_mistake_in_a_file_causes_one_sentence_at_collection(
    pytester: pytest.Pytester, expect: dict[str, object], sentence: str
) -> None:
    write_scenario(pytester, "s.yaml", expect=expect)
    result = run(pytester, "s.yaml")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*_ ERROR collecting s.yaml _*", f"*s.yaml: {sentence}"])
    no_internals(result)


FOREIGN = {
    "api.yaml": "name: api\nrequest: {url: x}\nexpect: {status: 200}\n",
    "workflow.yml": "name: build\non: push\njobs: {test: {steps: [{uses: x}]}}\n",
    "tagged.yaml": "name: !vault |\n  6162\nexpect: !Ref x\nstages: []\n",
    "broken.yaml": "name: [\nexpect: }\nwhat: ever\n",
    "bomb.yaml": "a: &a [x, x]\nb: &b [*a, *a]\nname: [*b, *b]\nexpect: [*b]\n",
    "nested.yaml": "test:\n  name: x\n  expect:\n    seeds: [1]\n",
    "binary.yaml": "name: \x00\xff\nexpect:\x01 seed\n",
    "deep.yaml": "[" * 100_000,
    "status.yaml": "name: x\nexpect: 200\n",
    "mapping.yaml": "name: x\nexpect:\n  characterstics: {1: holds}\n",
    "empty.yaml": "",
    "list.yaml": "- name: x\n  expect: {}\n",
}


def test_other_yaml_files_are_not_collected(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\ntestpaths = .")
    for name, text in FOREIGN.items():
        (pytester.path / name).write_text(text, encoding="latin-1")
    (pytester.path / "directory.yaml").mkdir()
    (pytester.path / "nowhere.yaml").symlink_to("missing")
    (pytester.path / "huge.yaml").write_text("name: x\nexpect: {seeds: [1]}\n" + "#" * 9_000_000)
    os.mkfifo(pytester.path / "pipe.yaml")
    pytester.makepyfile("def test_theirs(): pass")
    result = run(pytester)
    result.assert_outcomes(passed=1)
    assert "warning" not in result.stdout.str()


def test_invalid_yaml_is_reported_in_one_sentence(pytester: pytest.Pytester) -> None:
    (pytester.path / "s.yaml").write_text("name: x\nexpect: {seeds: [1}\n")
    result = run(pytester, "s.yaml")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*s.yaml: not YAML at line 2: *"])
    no_internals(result)


def test_run_directories_are_kept_in_the_given_place_and_not_overwritten(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "s.yaml", expect={})
    for _ in range(2):
        run(pytester, "s.yaml", "--ucp-keep", "kept", "--ucp-speedup", 7).assert_outcomes(passed=1)
    kept = sorted(path.name for path in (pytester.path / "kept").iterdir())
    assert kept == ["s-yaml-sim-seed1", "s-yaml-sim-seed1-2"]
    for name in kept:
        assert "<html" in (pytester.path / "kept" / name / "report.html").read_text()
        assert json.loads((pytester.path / "kept" / name / "run.json").read_text())["scenario"]["speedup"] == 7


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("--ucp-speedup", 0, "*`speedup` is 0*: it should be greater than 0"),
        ("--ucp-seed", -1, "--ucp-seed is -1: use a number from 0 on"),
    ],
)
def test_invalid_option_is_reported_in_one_sentence(
    pytester: pytest.Pytester, option: str, value: int, sentence: str
) -> None:
    write_scenario(pytester, "s.yaml", expect={})
    result = run(pytester, "s.yaml", f"{option}={value}")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([sentence])
    no_internals(result)


def test_failed_test_names_the_programs_of_foreign_agents(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "mixed.yaml", expect={"figures": {"blocks": 999}})
    agent = f"2={shlex.quote(sys.executable)} -P -m ucp.node"
    result = run(pytester, "mixed.yaml", "--ucp-agent", agent)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["blocks *999*", "agents 1, 3 ran the harness's own; agent 2 ran * -P -m ucp.node", "report: *"]
    )
