"""Test that the examples in docs/how-to/import-other-logs.md work as described.

Test that the commands in docs/how-to/find-a-field-bug.md print the output on the page.

Test that the table in docs/appendix/wrong-agents-field.md is complete and correct.
"""

import re
import shutil
from pathlib import Path

import pytest

from docs.generate.wrong_agents import at_the_desk
from docs.generate.wrong_agents.at_the_desk import AtTheDesk, Named, row
from docs.generate.wrong_agents.trials_page import rows_of
from harness.archive.packets.capture_files import capture_files, read_captures
from harness.errors import FieldError
from harness.field.adapters import import_records
from harness.field.adapters.adapter import load_adapter
from harness.field.adapters.csv_adapter import CsvAdapter
from tests.harness.command import harness, sentences
from tests.harness.field.flights import flown, trace_of
from tests.pages import play
from ucp.quirks import QUIRKS

PAGE = (Path(__file__).parents[3] / "docs/how-to/import-other-logs.md").read_text()
TEXTS = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
LOG = "".join(line for line in TEXTS[0].splitlines(keepends=True) if " STEP " not in line)
"""A log without the entry `step`, which the page abridges."""
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def swarmlog(tmp_path: Path) -> Path:
    path = tmp_path / "swarmlog.py"
    path.write_text(PROGRAMS[0])
    return path


def test_example_adapter_reads_the_example_log(swarmlog: Path, tmp_path: Path) -> None:
    (tmp_path / "flight.log").write_text(LOG + "1790000015.0 ??? 12\n")
    done = harness("import", "--adapter", f"{swarmlog}:SwarmLog", tmp_path / "flight.log", "-o", tmp_path / "home")
    assert done.returncode == 0
    assert f"{tmp_path / 'home'}: agents 7: 1 capture(s), 1 list(s) of events\n" == done.stdout
    assert sentences(done.stderr) == [
        f"{tmp_path / 'flight.log'}, line 5: the log is damaged here: '???' is no kind of line"
    ]
    captures = read_captures(capture_files([tmp_path / "home"]))
    assert captures.used[0].vehicle == 7 and [each.sender for each in captures.datagrams] == [7, 28]


def test_steps_of_the_example_are_judged(swarmlog: Path, tmp_path: Path) -> None:
    run = flown(tmp_path / "run")
    for agent in (1, 2, 3):
        lines = (f"1790000000.0 STEP {line}" for line in trace_of(run, agent).read_text().splitlines())
        (tmp_path / f"{agent}.log").write_text("\n".join([f"# swarmlog 1 agent={agent}", *lines, ""]))
    logs = [tmp_path / f"{agent}.log" for agent in (1, 2, 3)]
    import_records(logs, [load_adapter(f"{swarmlog}:SwarmLog")], tmp_path / "home")
    checked = harness("check", tmp_path / "home")
    assert re.search(r"every step +✔ as specified", checked.stdout)


def test_example_subclass_reads_other_topics(tmp_path: Path) -> None:
    (tmp_path / "our_bags.py").write_text(PROGRAMS[1])
    assert load_adapter(f"{tmp_path / 'our_bags.py'}:OurBags").counts == "message"


def test_example_rows_are_read(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text(TEXTS[1])
    record = import_records([tmp_path / "rows.csv"], [CsvAdapter()], tmp_path / "home")
    assert not record.left_out and record.flights[0].agents[7].capture and record.flights[0].agents[7].events


@pytest.mark.parametrize("name", ["nothing", "nowhere:SwarmLog", "{}:Nobody", "{}:Path", "no.py:A", ":", "json:loads"])
def test_invalid_adapter_gives_one_sentence(swarmlog: Path, name: str) -> None:
    with pytest.raises(FieldError, match=r"import-other-logs\.md"):
        load_adapter(name.format(swarmlog))


def test_failing_adapter_keeps_earlier_observations(swarmlog: Path, tmp_path: Path) -> None:
    swarmlog.write_text(PROGRAMS[0].replace("except ValueError", "except KeyError"))
    (tmp_path / "flight.log").write_text(LOG + "nonsense\n")
    out = tmp_path / "home"
    record = import_records([tmp_path / "flight.log"], [load_adapter(f"{swarmlog}:SwarmLog")], out)
    assert record.flights[0].agents[7].capture
    (left_out,) = record.left_out
    assert "reading failed after line 4: ValueError: not enough values to unpack" in left_out.sentence


ROOT = Path(__file__).parents[3]
FIELD_BUGS_PAGE = ROOT / "docs/how-to/find-a-field-bug.md"


def test_commands_print_the_output_on_the_page(tmp_path: Path) -> None:
    for directory in ("ucp", "docs"):
        shutil.copytree(ROOT / directory, tmp_path / directory, ignore=shutil.ignore_patterns("__pycache__"))
    assert play(FIELD_BUGS_PAGE, tmp_path, columns=150) > 12


def test_code_lines_on_the_page_are_current() -> None:
    code = (ROOT / "ucp/quirks/_reconcile_quirks.py").read_text().splitlines()
    assert code[164].strip() == "raise NameError"
    assert code[189].strip() == "core.start(core.phase_three_timer, 0.0)"


ROWS = rows_of(at_the_desk.PAGE.read_text(encoding="utf-8"))


def test_each_quirk_has_a_row() -> None:
    assert list(ROWS) == list(QUIRKS), "write it again: python -m docs.generate.wrong_agents.at_the_desk"


def test_replay_finds_each_wrong_agent() -> None:
    assert not [quirk for quirk, line in ROWS.items() if "no difference" in line]


def test_row_has_the_first_difference_and_counts_correct_handlers() -> None:
    late = Named(120.0, "vote_timer_expiration", "it sent nothing; it should have sent Commit Block about block 2.1")
    early = Named(60.0, "receive_commit_block", "it took the branch 'a|b'")
    assert row("hide_commits", AtTheDesk(2, 5, (late, early))) == (
        "| `hide_commits` | 5 | `receive_commit_block` | 1 of 2 | 1.0 | 2 | `it took the branch 'a\\|b'` |\n"
    )
    assert "no difference" in row("hide_commits", AtTheDesk(8, 5, ()))
