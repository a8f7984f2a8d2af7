"""Test that a trigger of each kind can be written to a trace and read from it without a change."""

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from ucp.trigger import (
    BootTrigger,
    EventTrigger,
    LocalTrigger,
    MessageTrigger,
    OperatorTrigger,
    TimerTrigger,
    Trigger,
    UnknownTrigger,
    parse,
)

KINDS: list[tuple[dict[str, Any], Trigger]] = [
    ({"message": "Commit Block", "from": 3, "seq": 17}, MessageTrigger("Commit Block", 3, 17)),
    ({"event": 5}, EventTrigger(5)),
    ({"timer": "voting"}, TimerTrigger("voting")),
    ({"local": "reconcile_begin"}, LocalTrigger("reconcile_begin")),
    ({"operator": "reconcile"}, OperatorTrigger("reconcile")),
    ({"boot": 2}, BootTrigger(2)),
]


@pytest.mark.parametrize(("fields", "trigger"), KINDS, ids=lambda value: getattr(value, "kind", ""))
def test_trigger_is_read_and_written_as_the_same_object(fields: dict[str, Any], trigger: Trigger) -> None:
    assert parse(fields) == trigger
    assert list(trigger.to_json().items()) == list(fields.items())
    assert trigger.subject == fields[trigger.kind]


def test_triggers_of_different_kinds_differ() -> None:
    assert TimerTrigger("reconcile") != OperatorTrigger("reconcile")
    assert EventTrigger(2) != BootTrigger(2)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"reason": "none"},
        {"message": "Commit Block"},
        {"message": "Commit Block", "from": "3", "seq": 17},
        {"message": 4, "from": 3, "seq": 17},
        {"timer": 5},
        {"event": "5"},
        {"timer": "voting", "local": "reconcile_begin"},
        {"message": "Commit Block", "from": 3, "seq": 17, "boot": 1},
    ],
    ids=str,
)
def test_invalid_trigger_is_kept_as_unknown_trigger(fields: dict[str, Any]) -> None:
    trigger = parse(fields)
    assert isinstance(trigger, UnknownTrigger)
    assert hash(trigger) == hash(UnknownTrigger(dict(reversed(trigger.fields.items()))))
    assert trigger.to_json() == fields


def test_key_beside_the_kind_is_ignored() -> None:
    assert parse({"timer": "voting", "note": 1}) == TimerTrigger("voting")


def test_pydantic_reads_a_trigger_and_refuses_other_values() -> None:
    adapter: TypeAdapter[Trigger] = TypeAdapter(Trigger)
    assert adapter.validate_json('{"boot": 2}') == BootTrigger(2)
    for wrong in ("[]", '"boot"', '{"boot": null}'):
        with pytest.raises(ValidationError):
            adapter.validate_json(wrong)
