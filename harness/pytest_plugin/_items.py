"""Create tests from scenarios and stories: one test for each backend and seed."""

from collections.abc import Iterator
from difflib import unified_diff
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from harness.archive.archive import RunArchive
from harness.archive.vocabulary import first_unknown, unknown_names
from harness.backend_names import BackendName
from harness.errors import HarnessError, ScenarioError
from harness.play.backends import in_virtual_time
from harness.pytest_plugin._fixtures import play
from harness.pytest_plugin._judged_run import RunOfOneTest, discard, new_directory, one_sentence
from harness.pytest_plugin._options import SessionOptions
from harness.pytest_plugin._stash import TRIAL
from harness.report.stories.narration import StoryWriter
from harness.report.stories.story_file import Story, read_story
from harness.scenario import Scenario, load_scenario
from harness.scenario.expect import Expect


class ScenarioFile(pytest.File):
    def collect(self) -> Iterator[pytest.Item]:
        try:
            options = SessionOptions.of(self.config)
            scenario = options.applied_to(load_scenario(self.path))
        except HarnessError as error:
            raise self.CollectError(str(error)) from None
        expect = scenario.expect or Expect()
        backends = expect.backends if options.backend is None else [options.backend]
        seeds = expect.seeds if options.seed is None else [options.seed]
        for backend, seed in product(backends, seeds):
            name = f"{backend}-seed{seed}"
            yield ScenarioItem.from_parent(self, name=name, scenario=scenario, backend=backend, seed=seed)


class ScenarioItem(pytest.Item):
    """The pytest item for one run of a scenario. `pytest_runtest_call` judges the run."""

    def __init__(self, *, scenario: Scenario, backend: BackendName, seed: int, **node: Any) -> None:
        super().__init__(**node)
        self._scenario = scenario
        self._backend = backend
        self._seed = seed
        self._directory: Path | None = None

    def runtest(self) -> None:
        with one_sentence():
            options = SessionOptions.of(self.config)
            options.refuse(self._backend)
            self._directory = new_directory(self, options)
            finished = play(self._scenario, self._seed, self._backend, self._directory, options.variant)
        self.stash[TRIAL] = RunOfOneTest(self._scenario, lambda _: finished, options.variant)

    def teardown(self) -> None:
        if self._directory is not None and TRIAL in self.stash and self.stash[TRIAL].passed:
            discard(self._directory, SessionOptions.of(self.config))

    def reportinfo(self) -> tuple[Path, None, str]:
        return self.path, None, f"{self.path.name}::{self.name}"


CONTEXT_LINES = 3


class StoryFile(pytest.File):
    def collect(self) -> Iterator[pytest.Item]:
        try:
            options = SessionOptions.of(self.config)
            play = read_story(self.path)
        except HarnessError as error:
            raise self.CollectError(str(error)) from None
        backends = (play.scenario.expect or Expect()).backends if options.backend is None else [options.backend]
        for backend in backends:
            yield StoryItem.from_parent(self, name=backend, play=play, backend=backend)


class StoryItem(pytest.Item):
    """The pytest item for one run of a story, a text file that describes a mission. `pytest_runtest_call` judges the
    run.
    """

    def __init__(self, *, play: Story, backend: BackendName, **node: Any) -> None:
        super().__init__(**node)
        self._story = play
        self._backend = backend
        self._directory: Path | None = None

    def runtest(self) -> None:
        options = SessionOptions.of(self.config)
        with one_sentence():
            options.refuse(self._backend)
            virtual = in_virtual_time(self._backend)
            if not virtual:
                self._skip_what_needs_virtual_time()
            scenario = options.applied_to(self._story.in_virtual_time if virtual else self._story.scenario)
            self._directory = new_directory(self, options)
            seed = 1 if options.seed is None else options.seed
            finished = play(scenario, seed, self._backend, self._directory, options.variant, delivers_all=True)
        self.stash[TRIAL] = RunOfOneTest(scenario, lambda _: finished, options.variant)
        if finished.played.outcome != "completed":
            return  # the judgement of the run reports the reason
        archive = RunArchive(finished.directory)
        text = self._played_text(archive)
        if options.rewrite:
            self._rewrite(text)
        elif text != self._story.text:
            if unknown := self._unknown_word(archive):
                pytest.skip(f"the traces cannot be compared with the story: {unknown}")
            pytest.fail(
                "\n".join([*self._difference(text), *archive.problems, *archive.gaps, f"report: {finished.report}"]),
                pytrace=False,
            )

    def _skip_what_needs_virtual_time(self) -> None:
        from harness.play.process.process_preflight import refuse_virtual_time_keys

        try:
            refuse_virtual_time_keys(self._story.scenario)
        except ScenarioError as error:
            pytest.skip(str(error))

    def _rewrite(self, text: str) -> None:
        try:
            self.path.write_text(text, encoding="utf-8")
        except OSError as error:
            pytest.fail(f"{self.path} cannot be written: {error.strerror}", pytrace=False)

    def _played_text(self, archive: RunArchive) -> str:
        """Return the text of a story with the inputs of the story file and the reactions of the agents in this run."""
        narrator = StoryWriter(archive.traces, self._story.scenario.roster)
        answers = [narrator.answer(section, first=number == 0) for number, section in enumerate(self._story.sections)]
        return self._story.with_answers(answers)

    def _unknown_word(self, archive: RunArchive) -> str | None:
        """Return a description of the first name in a trace that stories do not support. Return None if stories support
        all names in the traces.
        """
        for agent_id, trace in archive.traces.items():
            if unknown := first_unknown(unknown_names(trace.runs)):
                return f"{unknown} in the trace of agent {agent_id}"
        return None

    def _difference(self, text: str) -> Iterator[str]:
        yield "agents deviate from the story; if the agents are right, --ucp-rewrite rewrites the story"
        yield from unified_diff(
            self._story.text.splitlines(),
            text.splitlines(),
            f"{self.path.name}, as written",
            "as played",
            lineterm="",
            n=CONTEXT_LINES,
        )

    def teardown(self) -> None:
        if self._directory is not None and TRIAL in self.stash and self.stash[TRIAL].passed:
            discard(self._directory, SessionOptions.of(self.config))

    def reportinfo(self) -> tuple[Path, None, str]:
        return self.path, None, f"{self.path.name}::{self.name}"
