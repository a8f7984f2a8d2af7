"""Run `ucp-harness` in the tests of workflows, but without the parts that take long.

The commands `conformance` and `doctor` only parse their options, and a random search plays only two runs.
"""

import sys
from pathlib import Path

from harness.cli import load_command, main

if __name__ == "__main__":
    name, *arguments = sys.argv[1:]
    if name in ("conformance", "doctor"):
        parsed = load_command(name).make_context(name, arguments).params
        output = parsed.get("page") if parsed.get("matrix") else parsed.get("junit")
        if output:
            Path(output).write_text("<testsuite/>")
        sys.exit(0)
    if "--for" in arguments:
        at = arguments.index("--for")
        arguments[at : at + 2] = ["--runs", "2"]
    sys.argv[1:] = [name, *arguments]
    main()
