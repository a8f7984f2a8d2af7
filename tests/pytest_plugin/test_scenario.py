"""Test the fixture `scenario`, which plays a scenario and provides its verdicts."""

import pytest

from tests.pytest_plugin.inner import no_internals, report, run, run_directories, write_scenario

pytest_plugins = "pytester"


def test_fixture_provides_the_findings_of_the_marked_scenario(pytester: pytest.Pytester) -> None:
    pytester.mkpydir("deep")
    write_scenario(pytester, "deep/lossy.yaml", network={"loss": 0.1}, duration_s=300, final_reconcile=True)
    (pytester.path / "deep" / "test_deep.py").write_text(
        "import json, pytest\n"
        '@pytest.mark.scenario("lossy.yaml", backend="sim", seed=3)\n'
        "def test_lossy(scenario):\n"
        "    assert scenario.characteristic(6).holds\n"
        '    assert len(scenario.chain(1)) == scenario.figures["mutual_chain"] > 0\n'
        '    assert json.loads((scenario.directory / "run.json").read_text())["seed"] == 3\n'
    )
    run(pytester).assert_outcomes(passed=1)
    assert not run_directories(pytester)


def test_expectations_of_the_scenario_are_judged_with_the_test(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "s.yaml", expect={"figures": {"blocks": {"min": 1000}, "distinct_chains": 2, "agents": 3}})
    pytester.makepyfile('import pytest\n@pytest.mark.scenario("s.yaml")\ndef test_s(scenario): pass')
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*_ test_s _*",
            "blocks is *, and should be at least 1000",
            "distinct chains is *, and should be 2",
            "report: *",
        ]
    )
    result.stdout.no_fnmatch_line("agents is*")
    no_internals(result)
    report(result)


@pytest.mark.parametrize(
    ("marker", "sentence"),
    [
        ("", "the fixture `scenario` needs a marker with a scenario, *"),
        ('@pytest.mark.scenario("s.yaml", agents=3)', "the fixture `scenario` needs a marker with a scenario, *"),
        ('@pytest.mark.scenario("none.yaml")', "*none.yaml: no such file or scenario*"),
        ('@pytest.mark.scenario("s.yaml", seed="one")', "`seed` is 'one': use a number from 0 on"),
        ('@pytest.mark.scenario("fates.yaml", backend="process")', "`fates` needs virtual time: use --backend sim"),
    ],
)
def test_unplayable_scenario_is_reported_in_one_sentence(pytester: pytest.Pytester, marker: str, sentence: str) -> None:
    write_scenario(pytester, "s.yaml")
    write_scenario(pytester, "fates.yaml", fates=[{"sender": 1, "count": 1, "drop": True}])
    pytester.makepyfile(f"import pytest\n{marker}\ndef test_mistake(scenario): pass")
    result = run(pytester)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([sentence])
    no_internals(result)


def test_fate_without_a_match_fails_the_test(pytester: pytest.Pytester) -> None:
    write_scenario(pytester, "s.yaml", fates=[{"message": "Commit Block", "block": "1.900", "drop": True}])
    pytester.makepyfile('import pytest\n@pytest.mark.scenario("s.yaml")\ndef test_s(scenario): pass')
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*block 1.900*, so this run differs from its script"])


def test_unavailable_backend_is_skipped_with_the_remedy(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(pytester.path))  # where there is neither unshare nor nft
    write_scenario(pytester, "s.yaml", expect={"backends": ["process"]})
    pytester.makepyfile("""
    import pytest

    @pytest.mark.scenario("s.yaml", backend="process")
    def test_scenario(scenario): pass

    @pytest.mark.swarm(backend="process")
    def test_swarm(swarm): pass
    """)
    result = run(pytester, "-rs", "s.yaml", pytester.path)
    result.assert_outcomes(skipped=3)
    result.stdout.fnmatch_lines(["SKIPPED *is not installed*apt install*"] * 1)
    no_internals(result)


def test_marker_names_an_included_scenario(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("""
        import pytest

        @pytest.mark.scenario("perfect", backend="sim", seed=1)
        def test_perfect(scenario):
            assert scenario.figures["distinct_chains"] == 1
    """)
    run(pytester).assert_outcomes(passed=1)
