"""The agent program for a protocol variant: `ucp.node` with the handlers of the variant.

python -m harness.play.variant_agent VARIANT_FILE MISSION_FILE
"""

import sys
from pathlib import Path

from harness.errors import HarnessError
from harness.play.variant import core_in_force, load_variant
from ucp.node import main as node

WRONG_REQUEST = 2


def main(arguments: list[str]) -> int:
    """Run the agent, and return its exit status. The statuses are those of `ucp.node`."""
    if not arguments:
        sys.stderr.write("usage: python -m harness.play.variant_agent VARIANT_FILE MISSION_FILE\n")
        return WRONG_REQUEST
    try:
        variant = load_variant(Path(arguments[0]))
    except HarnessError as error:
        sys.stderr.write(f"{error}\n")
        return WRONG_REQUEST
    with core_in_force(variant):
        return node(arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
