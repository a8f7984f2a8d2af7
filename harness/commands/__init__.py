"""The commands of the command line, one module each; harness/cli.py puts them together."""
