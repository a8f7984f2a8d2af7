"""Mistakes that a scenario's agents are asked to make (`ucp.quirks`): all of them make it, or some.

quirks: {ignore_commit: 0.2, crash_on_tie: {agents: [32, 122]}}
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema

from harness.scenario.strict_model import Model, VehicleId
from ucp.quirks import QUIRKS, Quirks, check_quirk


class OfSome(Model):
    """A mistake of these agents only; `value` is true, or the probability of a quirk that has one."""

    agents: Annotated[list[VehicleId], Field(min_length=1)]
    value: bool | float = True


def _schema() -> dict[str, Any]:
    known = {}
    for name, quirk in QUIRKS.items():
        kind, bounds = ("number", {"minimum": 0, "maximum": 1}) if quirk.chance else ("boolean", {})
        known[name] = {
            "description": quirk.sentence,
            "type": [kind, "object"],
            **bounds,
            "properties": {"agents": {"type": "array", "minItems": 1}, "value": {"type": kind, **bounds}},
            "required": ["agents", "value"] if quirk.chance else ["agents"],
            "additionalProperties": False,
        }
    return {"type": "object", "properties": known, "additionalProperties": False}


Asked = Annotated[
    bool | float | OfSome,
    BeforeValidator(lambda value: OfSome.model_validate(value) if isinstance(value, Mapping) else value),
]
AskedQuirks = Annotated[dict[str, Asked], WithJsonSchema(_schema())]
"""Quirk -> its value, or which agents have it."""


def check(asked: Mapping[Any, Any]) -> None:
    """Raises ValueError, before anybody looks at agents: which quirks there are, and what their values may be."""
    for name, said in asked.items():
        value = said.get("value", True) if isinstance(said, Mapping) else said
        check_quirk(str(name), value.value if isinstance(value, OfSome) else value)


def of_agent(asked: Mapping[str, bool | float | OfSome], agent_id: int) -> Quirks:
    """What the agent is asked to do wrong: for its mission file."""
    own: Quirks = {}
    for name, value in asked.items():
        if not isinstance(value, OfSome):
            own[name] = value
        elif agent_id in value.agents:
            own[name] = value.value
    return own


def in_words(asked: Mapping[str, bool | float | OfSome]) -> Iterator[str]:
    """For each quirk in force who has it: "crash_on_tie (agents 32 and 122)", "ignore_commit 0.2 (all agents)"."""
    for name, said in asked.items():
        value = said.value if isinstance(said, OfSome) else said
        if value:
            named = name if value is True else f"{name} {value:g}"
            yield f"{named} ({_agents(sorted({*said.agents})) if isinstance(said, OfSome) else 'all agents'})"


def _agents(ids: list[int]) -> str:
    *others, last = map(str, ids)
    return f"agents {', '.join(others)} and {last}" if others else f"agent {last}"
