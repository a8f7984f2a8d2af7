"""The commands of the command line. Each module defines one, and harness/cli.py lists them."""
