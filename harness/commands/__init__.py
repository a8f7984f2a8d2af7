"""The commands of the command line. Each module defines one command, and harness/cli.py lists all commands."""
