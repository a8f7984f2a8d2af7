"""What starts agents: one command for all, or one for each agent that is named; all others run the harness's own.

agent_command: [./my_agent, --fast]
agent_command: {2: [./my_agent, --fast], 5: [./another_agent]}
"""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from harness.scenario.strict_model import VehicleKey
from ucp.block import MAX_AGENT_ID
from ucp.short_value import shown

MAX_WORDS = 100

Command = Annotated[list[str], Field(min_length=1, max_length=MAX_WORDS)]
"""A program that follows ucp/contract/CONTRACT.md, and its arguments; the mission file's name is added."""


def _commands(asked: Any) -> Any:
    """Raises ValueError for what is neither: of a union pydantic would tell what is wrong by either reading."""
    if isinstance(asked, Mapping):
        for agent, words in asked.items():
            if not _is_agent(agent):
                raise ValueError(f"{shown(agent)} is not an agent ID: it should be 1..{MAX_AGENT_ID}")
            if not _is_command(words):
                raise ValueError(f"agent {shown(agent)} needs a program and its arguments, as a list")
    elif asked is not None and not _is_command(asked):
        raise ValueError("should be a program and its arguments, as a list, or a mapping of agent IDs to such lists")
    return asked


def _is_agent(key: object) -> bool:
    digits = shown(key).strip("'")
    return digits.isdecimal() and len(digits) <= len(str(MAX_AGENT_ID)) and 1 <= int(digits) <= MAX_AGENT_ID


def _is_command(words: Any) -> bool:
    return (
        isinstance(words, list)
        and 1 <= len(words) <= MAX_WORDS
        and all(isinstance(word, str) and "\0" not in word for word in words)
    )


AgentCommand = Annotated[Command | dict[VehicleKey, Command] | None, BeforeValidator(_commands)]
