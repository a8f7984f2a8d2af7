"""The rooms of the house stand as docs/architecture.md says: each uses those before it, and none below."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
LOOSE_AT_MOST = 5


def test_packages_import_one_way() -> None:
    may_use = {"ucp": set(), "sitl": set(), "netem": set(), "harness": {"ucp", "sitl", "netem"}}
    for package, others in may_use.items():
        used = {name.split(".")[0] for path in (REPOSITORY / package).rglob("*.py") for name in imported(path)}
        assert used & may_use.keys() <= others | {package}, package


def test_a_room_of_the_harness_uses_only_rooms_above_it() -> None:
    table = (REPOSITORY / "docs/architecture.md").read_text().split("In [harness/](../harness)")[1]
    rooms = re.findall(r"^\| \[(\w+)/\]\(../harness/\w+\)", table, re.MULTILINE)
    assert {path.parent.name for path in (REPOSITORY / "harness").glob("*/__init__.py")} - {"schemas"} == {*rooms}
    for number, room in enumerate(rooms):
        for path in (REPOSITORY / "harness" / room).rglob("*.py"):
            used = {name.split(".")[1] for name in imported(path) if name.startswith("harness.")}
            assert not used & {*rooms[number + 1 :]}, path


def test_few_files_of_the_harness_are_in_no_room() -> None:
    assert len([*(REPOSITORY / "harness").glob("*.py")]) <= LOOSE_AT_MOST


def imported(path: Path) -> Iterator[str]:
    """The modules that a file imports, wherever in it; of `from harness import checker`, harness.checker."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
