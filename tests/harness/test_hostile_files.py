"""Test commands with files that an attacker made: they print one sentence within a short time, and never a
traceback.
"""

import ast
import os
import shutil
from pathlib import Path

import pytest

from harness.errors import ScenarioError
from harness.scenario.load import parse_yaml
from tests.harness.command import harness, sentences

pytestmark = pytest.mark.any_user

REPOSITORY = Path(__file__).parents[2]
ROOMS_WITH_READERS = ("scenario", "archive", "checker", "report", "run", "field", "sweep", "commands", "pytest_plugin")
OWN_FILES = {
    "checker/steps/_shared_code.py": "test vectors of the package",
    "field/bisection/_live_replay.py": "outputs of programs that it started",
    "field/bisection/_scripted_peers.py": "a script that its parent wrote",
    "pytest_plugin/_yaml_files.py": "small regular files of a project, which may have a package `ucp` of its own",
    "report/html.py": "templates that it compiled",
    "run/provenance.py": "the modules of the project",
    "scenario/load.py": "the library",
    "sweep/matrix/_results_file.py": "a file that it also writes",
}
"""Modules that read files without `ucp.plain_file`, and the files that each module reads. Package data need no
entry.
"""


def _reads(node: ast.AST) -> bool:
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    package_data = any(name in ast.unparse(node.func) for name in ("__file__", "_HERE", "_TEMPLATE", "_PAGE"))
    modes = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
    opens = node.func.attr == "open" and any(str(mode).startswith("r") for mode in modes)
    return (opens or node.func.attr in ("read_text", "read_bytes")) and not package_data


def test_readers_of_unknown_files_use_the_bounded_reader() -> None:
    readers = {
        str(path.relative_to(REPOSITORY / "harness"))
        for room in ROOMS_WITH_READERS
        for path in (REPOSITORY / "harness" / room).rglob("*.py")
        if any(_reads(node) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert readers - {"report/live/server.py"} == OWN_FILES.keys()  # the live server reads its page


@pytest.fixture(scope="module")
def run_of_fifos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run directory in which each file is a FIFO."""
    run = tmp_path_factory.mktemp("hostile") / "run"
    for name in (
        *("run.json", "network.jsonl", "tracks.jsonl", "lag.jsonl", "channel.jsonl", "rogue.jsonl", "public.json"),
        *("agents/1.chain.json", "agents/1.trace.jsonl", "agents/1.store", "agents/1.mission.json", "agents/1.log"),
        *("before_final_reconcile/1.chain.json", "capture/1.pcapng", "vehicles/1/telemetry.tlog"),
    ):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        os.mkfifo(run / name)
    return run


SHOW_THE_REST = ("report", "export", "mission verify")
"""Commands that print the readable part of a run and report the other files."""


@pytest.mark.parametrize(
    "arguments",
    [
        *("check {}", "report {}", "chain {}", "packets {}", "diff {} {}", "replay {}", "run {} --out {}/../o"),
        *("consolidate {}", "import {} --out {}/../o", "reconstruct {} --out {}/../o.yaml", "mission verify {}"),
        *("export {} --perfetto {}/../o", "calibrate {} --out {}/../o.yaml", "validate {}", "coverage {}"),
        *("check {}/agents/1.chain.json", "replay {}/agents/1.trace.jsonl", "packets {}/capture/1.pcapng"),
        *("explore {}/run.json", "matrix {}/run.json", "conformance --matrix {}/run.json", "keys inspect {}"),
    ],
)
def test_fifo_as_a_file_does_not_block_the_command(arguments: str, run_of_fifos: Path) -> None:
    ended = harness(*arguments.replace("{}", str(run_of_fifos)).split(), deadline_s=30)
    shutil.rmtree(run_of_fifos.parent / "o", ignore_errors=True)
    assert sentences(ended.stderr) or ended.stdout
    assert ended.returncode in ((0, 1, 2) if arguments.startswith(SHOW_THE_REST) else (2,)), ended.stdout


BOMB = "a0: &a0 {k: 1, l: 2}\n" + "".join(
    f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]\n" for level in range(1, 8)
)
MERGES = "a0: &a0 {k: 1, l: 2}\n" + "".join(
    f"a{level}: &a{level} {{<<: [{', '.join([f'*a{level - 1}'] * 10)}]}}\n" for level in range(1, 8)
)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (BOMB, "more than 300000 values"),
        (MERGES, "more than 300000 values"),
        ("x: [" + "1," * 310_000 + "1]", "more than 300000 values"),
        ("agents: 1" + ":1" * 300_000, "a number of hundreds of digits"),
        ("agents: 1" + ":1" * 300_000 + ".5", "a number of hundreds of digits"),
        ("agents: 0x" + "f" * 5000, "a number of hundreds of digits"),
        ("[" * 60 + "]" * 60, "it is nested too deeply"),
        ("- " * 60, "it is nested too deeply"),
        ("a: 1\na: 2", "a is repeated"),
    ],
    ids=["aliases", "merges", "values", "sexagesimal", "sexagesimal float", "hexadecimal", "flow", "block", "keys"],
)
def test_hostile_yaml_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem):
        parse_yaml(text)


def test_aliases_within_the_limit_are_read() -> None:
    assert parse_yaml("a: &a {b: 1}\nc: {<<: *a}\nd: [*a, *a]") == {"a": {"b": 1}, "c": {"b": 1}, "d": [{"b": 1}] * 2}


@pytest.mark.parametrize("module", ["typer", "harness.archive.directory"])
def test_interrupt_during_the_imports_is_quiet(module: str, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "def hook(event, arguments):\n"
        f"    if event == 'import' and arguments[0] == {module!r}:\n"
        "        os.kill(os.getpid(), 2)\n"
        "sys.addaudithook(hook)\n"
    )
    path = f"{tmp_path}:{REPOSITORY}"
    ended = harness(
        "run", "loss_15", "--backend", "sim", "--out", tmp_path / "run", env={**os.environ, "PYTHONPATH": path}
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")
