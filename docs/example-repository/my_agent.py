#!/usr/bin/env python3
"""Placeholder of your agent: it starts the agent of the harness. Replace it with your program, in any language."""

import sys

from ucp.node import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
