"""Play the recorded example missions with any agent, and compare its outputs: `python -m ucp.contract.vectors.replay
COMMAND...`.

The agent is started once, as `COMMAND... --virtual`, and plays all transcripts in turn. The program prints the first
difference of each transcript with its line. The exit status is 0 if there is no difference, and 1 otherwise.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ucp.contract.vectors import INDEX

MAY_BE_MISSING = frozenset(("tally", "started"))
"""Keys of a trace line that an agent may leave out."""
SHOWN = 200


class NoAnswerError(Exception):
    """An error: the agent program ended, or its output is not a JSON object."""


class Player:
    """An agent program that runs in virtual time. Raises OSError if the program cannot be started."""

    def __init__(self, command: list[str]) -> None:
        self._process = subprocess.Popen(
            [*command, "--virtual"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8"
        )

    def __enter__(self) -> "Player":
        return self

    def __exit__(self, *error: object) -> None:
        self._process.__exit__(*error)  # type: ignore[arg-type]

    def give(self, given: dict[str, Any]) -> dict[str, Any]:
        """Give the agent an input, and return its answer. Raises NoAnswerError."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(given) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise NoAnswerError("the agent has ended") from None
        line = self._process.stdout.readline()
        try:
            answer = json.loads(line)
        except ValueError:
            answer = None
        if not isinstance(answer, dict):
            raise NoAnswerError(f"the agent wrote {line[:SHOWN]!r}, and one JSON object was expected")
        return answer


def play(player: Player, transcript: Path) -> str | None:
    """Play a recorded mission. Return the first difference, or the reason why the agent cannot play the mission.

    Return None if all outputs of the agent are as expected. Raises NoAnswerError.
    """
    stores: dict[int, Any] = {}
    with transcript.open(encoding="ascii") as file:
        for number, line in enumerate(file, 1):
            exchange = json.loads(line)
            given, expected = exchange["input"], exchange["output"]
            if "store" in given:
                given = {**given, "store": stores[given["store"]["answer_of_line"]]}
            answer = player.give(given)
            if answer.get("unsupported"):
                return f"not supported: {answer.get('error')}"
            if "error" in answer and "error" not in expected:
                return f"line {number}: the agent answers the error {_shown(answer['error'])}"
            stores[number] = (answer.get("answer") or {}).get("store") if given.get("command") == "store" else None
            for where, got, wanted in differences(answer, expected):
                return f"line {number}: {where} is {_shown(got)}, and should be {_shown(wanted)}"
    return None


def differences(got: Any, wanted: Any, where: str = "output") -> Iterator[tuple[str, Any, Any]]:
    """Compare an output with the expected output. Yield each difference as (place, value, expected value). Additional
    keys of an object do not count.
    """
    if isinstance(wanted, dict) and isinstance(got, dict):
        for key, value in wanted.items():
            if key in got:
                yield from differences(got[key], value, f"{where}.{key}")
            elif key not in MAY_BE_MISSING:
                yield f"{where}.{key}", None, value
    elif isinstance(wanted, list) and isinstance(got, list):
        for index, (ours, theirs) in enumerate(zip(got, wanted, strict=False)):
            yield from differences(ours, theirs, f"{where}[{index}]")
        if len(got) != len(wanted):
            yield where, got, wanted
    elif got != wanted or isinstance(got, bool) != isinstance(wanted, bool):
        yield where, got, wanted


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def main(command: list[str]) -> int:
    """Play all recorded missions, and return the exit status."""
    differ = False
    with Player(command) as player:
        for name, about in json.loads(INDEX.read_text(encoding="ascii")).items():
            difference = play(player, INDEX.with_name(f"{name}.jsonl"))
            differ |= difference is not None and not difference.startswith("not supported")
            sys.stdout.write(f"{name:24} {difference or 'as it should be'}\n")
            if difference is not None:
                sys.stdout.write(f"{'':24} ({about['what']})\n")
    return int(differ)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python -m ucp.contract.vectors.replay COMMAND...")
    try:
        sys.exit(main(sys.argv[1:]))
    except (OSError, NoAnswerError) as error:
        sys.exit(str(error))
