"""Play every scenario that comes with the harness in virtual time, and show its chains in `docs/gallery.md`.

The pictures and figures come from runs with fixed seeds. They are the same each time, and they change with the code.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from harness.present.colours import inks
from harness.report.chain_tree_svg import ChainTreePicture
from harness.run.simulate import Simulated, simulate
from harness.scenario import Scenario, load_scenario
from harness.scenario.verdict_names import BAD_IN_WORDS

SCENARIOS = Path(__file__).parents[2] / "scenarios"
MARK = "<!-- gallery -->"
DEFAULT_SEED = 1


class Example(NamedTuple):
    """A scenario and a run of it."""

    name: str
    scenario: Scenario
    seed: int
    run: Simulated

    @property
    def picture(self) -> ChainTreePicture:
        """The picture of the chains at the end of the mission, before any final reconcile."""
        exports = self.run.evidence.before_final_reconcile or self.run.evidence.exports
        return ChainTreePicture(exports, inks(self.scenario.roster), key=self.name)


@cache
def examples() -> tuple[Example, ...]:
    """Play each scenario with its first expected seed."""
    found = []
    for path in sorted(SCENARIOS.glob("*.yaml")):
        if not path.stem.endswith("_matrix"):
            scenario = load_scenario(path)
            seeds = scenario.expect.seeds if scenario.expect else None
            seed = seeds[0] if seeds else DEFAULT_SEED
            found.append(Example(path.stem, scenario, seed, simulate(scenario, seed, tracing=True)))
    return tuple(found)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for example in examples():
        files.append(File.generated(config, f"gallery/{example.name}.svg", content=example.picture.standalone()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    return markdown.replace(MARK, gallery()) if MARK in markdown else markdown


def gallery() -> str:
    """Return a section for each scenario."""
    return "\n\n".join(map(_section, examples()))


def _section(example: Example) -> str:
    result = example.run.result
    bad = ", ".join(BAD_IN_WORDS[key] for key in result.bad)
    figures = result.figures
    return "\n\n".join(
        (
            f"## {example.scenario.name}",
            " ".join(example.scenario.about.split()),
            f"At the end of the run, {figures['agents']} agents hold a chain, and the swarm has completed "
            f"{_blocks(figures['blocks'])}. The longest chain has {_blocks(figures['longest_chain'])}, and the part "
            f"that all chains have in common has {_blocks(figures['mutual_chain'])}. "
            f"Verdict: {bad or 'all checks are good'}.",
            f"![{example.picture.description()}](gallery/{example.name}.svg)",
            f"    ucp-harness run {example.name} --backend sim --seed {example.seed}",
        )
    )


def _blocks(count: int) -> str:
    return "1 block" if count == 1 else f"{count} blocks"
