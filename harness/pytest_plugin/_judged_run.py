"""Judge the run of a test, and compare its results with the expectations in the scenario."""

import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import cast

import pytest

from harness.errors import HarnessError, MachineError, RunDirectoryError
from harness.pytest_plugin._options import SessionOptions
from harness.pytest_plugin.findings import JudgementInTest
from harness.report.agent_programs import in_sentence, programs
from harness.run.run import Run
from harness.scenario import Scenario
from harness.scenario.agent_options import quirks_in_words
from harness.scenario.expect import Expect


class RunOfOneTest:
    """The run of one test. The function `finish` ends the run and judges it. `finish(True)` first waits until the
    agents are idle.

    `variant` is the file of the protocol variant of the run. It is None if the run uses the original protocol.
    """

    def __init__(self, scenario: Scenario, finish: Callable[[bool], Run], variant: Path | None) -> None:
        self._variant = variant
        self._expect = scenario.expect or Expect()
        self._quirks = scenario.quirks
        self._finish = finish
        self.passed = False

    def end_of_test(self) -> None:
        """Raise pytest's exception Failed if the results of the run differ from the expectations."""
        try:
            finished = self._finish(True)
        except HarnessError as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        if finished.played.outcome == "not supported":
            pytest.skip(finished.played.outcome_detail or "not supported")
        if lines := self._unexpected(finished):
            pytest.fail("\n".join([*lines, *self._report_lines(finished)]), pytrace=False)
        self.passed = True

    def end_of_failed_test(self) -> str:
        """Return the findings about the run as text. pytest prints this text together with the failure of the test."""
        try:
            finished = self._finish(False)
        except HarnessError as error:
            return str(error)
        return "\n".join([*self._unexpected(finished), *self._report_lines(finished)])

    def _unexpected(self, finished: Run) -> list[str]:
        played = finished.played
        lines = [played.outcome_detail] if played.outcome_detail else []
        if played.outcome == "completed":
            lines += [f"{fate}, so this run differs from its script" for fate in played.unmatched_fates]
        for key, judgement in finished.result.judgements.items():
            if not self._expect.as_expected(key, judgement.verdict):
                expected = self._expect.verdict(key)
                lines += JudgementInTest.of(key, judgement).lines()
                lines += [f"    expected: {expected}"] if expected else []
        deviating = [(finding.agent_id, finding.handler) for finding in finished.result.beside["steps"].evidence]
        result = finished.result
        kinds = self._expect.unmet(result.figures, result.chains, result.top_chain_hashes, deviating)
        lines += [sentence for _, unmet in kinds for sentence in unmet]
        if not lines:
            return []
        wrong = ", ".join(quirks_in_words(self._quirks))
        ran = in_sentence(programs(finished.record))
        return [*lines, *([f"deliberate mistakes: {wrong}"] if wrong else []), *([ran] if ran else [])]

    def _report_lines(self, finished: Run) -> list[str]:
        """Return lines with the path of the report, and the command that repeats the run."""
        variant = [] if self._variant is None else ["--variant", str(self._variant)]
        command = ["ucp-harness", "run", str(finished.directory), "--backend", str(finished.record.backend), *variant]
        return [f"report: {finished.report}", f"again, with seed {finished.record.seed}: {shlex.join(command)}"]


@contextmanager
def one_sentence() -> Iterator[None]:
    """Turn an error of the harness into the result of the test, with a message of one sentence.

    The test is skipped if this machine cannot run it. After any other error, the test fails.
    """
    try:
        yield
    except MachineError as error:
        raise pytest.skip.Exception(str(error)) from None
    except HarnessError as error:
        raise pytest.fail.Exception(str(error), pytrace=False) from None


MAX_NAME = 100


def new_directory(node: pytest.Item, options: SessionOptions) -> Path:
    """Create an empty directory for the run of this test. Raises RunDirectoryError."""
    name = re.sub(r"\W+", "-", node.nodeid).strip("-")[-MAX_NAME:]
    if options.keep is None:
        factory = node.config._tmp_path_factory  # type: ignore[attr-defined] # items of YAML files have no fixtures
        return cast(pytest.TempPathFactory, factory).mktemp(name)
    for number in count(1):
        directory = options.keep / (name if number == 1 else f"{name}-{number}")
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise RunDirectoryError(f"--ucp-keep: {directory} cannot be created: {error.strerror}") from None
        return directory
    raise AssertionError("numbers do not end")


def discard(directory: Path, options: SessionOptions) -> None:
    """Remove the directory of a run without unexpected findings, unless the option `--ucp-keep` is set."""
    if options.keep is None:
        shutil.rmtree(directory, ignore_errors=True)
