"""Test the imports between the rooms (packages) of the harness.

Imports run in one direction, use public modules only, and form no circle. A room is one folder of `harness/`, or one of
the packages `ucp`, `ucp.contract`, `netem` and `sitl`. Only the room itself uses a module with a leading underscore.
Any other module is public: another room or a user imports it, or it is started as a program.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("harness", "ucp", "netem", "sitl")
LOOSE_AT_MOST = 8

DOORS = {
    "ucp.commit": "handlers, to read beside the thesis",
    "harness.cli": "a program",
    "harness.play.variant_agent": "a program",
    "harness.play.hosts.far_host": "a program",
    "harness.play.remote.far_worker": "a program",
    "harness.play.remote.stand_in": "a program",
    "netem.init": "a program",
    "netem.tap": "a program",
    "ucp.contract.vectors.replay": "a program",
    "harness.play.containers.start": "a program that is copied beside a compose file",
}
"""Public modules that no other room imports, each with the reason why it is public."""
LOADED_BY_NAME = ("harness.commands.", "harness.scenario.faults.", "harness.pytest_plugin.entry.")
"""Beginnings of the names of modules that are imported by their names at run time."""


@cache
def modules() -> dict[str, Path]:
    """Return the path of each module of the four packages, by the dotted name of the module."""
    found = {}
    for package in PACKAGES:
        for path in (REPOSITORY / package).rglob("*.py"):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports(module: str) -> frozenset[str]:
    """Return the modules that a module imports. Imports inside functions and for type annotations are included."""
    return frozenset(name for name in _imported(modules()[module]) if name != module)


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                if inside in modules() or node.module in modules():
                    yield inside if inside in modules() else node.module


def room_of(module: str) -> str:
    parts = module.split(".")
    if parts[0] == "harness":
        return ".".join(parts[:2])
    return "ucp.contract" if parts[:2] == ["ucp", "contract"] else parts[0]


def rooms_in_order() -> list[str]:
    """Return the rooms of the harness in the order of the table in docs/explanation/architecture.md."""
    page = (REPOSITORY / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    table = page.split("In [harness/](../../harness)")[1]
    return re.findall(r"^\| \[(\w+)/\]\(\.\./\.\./harness/\w+\)", table, re.MULTILINE)


@pytest.mark.parametrize(
    ("package", "may_use"), [("ucp", set()), ("sitl", set()), ("netem", set()), ("harness", {"ucp", "sitl", "netem"})]
)
def test_packages_import_one_way(package: str, may_use: set[str]) -> None:
    used = {name.split(".")[0] for module in modules() if module.split(".")[0] == package for name in imports(module)}
    assert used <= may_use | {package}


def test_running_agent_does_not_import_the_contract() -> None:
    users = [module for module in modules() if room_of(module) == "ucp" and _uses(module, "ucp.contract")]
    assert users == []


def test_table_names_every_room() -> None:
    assert {path.parent.name for path in (REPOSITORY / "harness").glob("*/__init__.py")} == {*rooms_in_order()}


def test_room_imports_only_rooms_above_it() -> None:
    order = [f"harness.{room}" for room in rooms_in_order()]
    up = [
        (module, name)
        for module in modules()
        if room_of(module) in order
        for name in imports(module)
        if room_of(name) in order and order.index(room_of(name)) > order.index(room_of(module))
    ]
    assert up == []


def test_few_files_of_the_harness_are_in_no_room() -> None:
    assert len([*(REPOSITORY / "harness").glob("*.py")]) <= LOOSE_AT_MOST


def test_no_module_imports_the_public_api() -> None:
    assert [module for module in modules() if "harness.api" in imports(module)] == []


def test_no_room_imports_a_private_module_of_another() -> None:
    past_the_door = [
        (module, name)
        for module in modules()
        for name in imports(module)
        if room_of(name) != room_of(module) and any(part.startswith("_") for part in name.split("."))
    ]
    assert past_the_door == []


def test_public_module_has_a_user_outside_its_room() -> None:
    used = {name for module in modules() for name in imports(module) if room_of(name) != room_of(module)}
    unused = [
        module
        for module, path in modules().items()
        if not path.name.startswith("_")
        and module not in used | {*DOORS}
        and not module.startswith(LOADED_BY_NAME)
        and not (module.count(".") == 1 and module.startswith("harness."))
        and not module.startswith("ucp.contract.examples.")
    ]
    assert unused == []


def test_every_listed_door_exists_and_needs_its_entry() -> None:
    used = {name for module in modules() for name in imports(module) if room_of(name) != room_of(module)}
    assert [door for door in DOORS if door not in modules()] == []
    assert [door for door in DOORS if door in used] == []


def test_modules_import_in_no_circle() -> None:
    """`graphlib` raises a CycleError that names the circle."""
    [*TopologicalSorter({module: imports(module) for module in modules()}).static_order()]


def test_rooms_import_in_no_circle() -> None:
    """`graphlib` raises a CycleError that names the circle. The package `ucp.contract` counts as a separate room."""
    graph: dict[str, set[str]] = {}
    for module in modules():
        graph.setdefault(room_of(module), set()).update({room_of(name) for name in imports(module)} - {room_of(module)})
    [*TopologicalSorter(graph).static_order()]


def _uses(module: str, package: str) -> bool:
    return any(name == package or name.startswith(f"{package}.") for name in imports(module))
