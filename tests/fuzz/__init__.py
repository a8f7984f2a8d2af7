"""Fuzz tests of all code that reads external input. With the package `atheris`, coverage guides the random changes.

finding.py     the conditions that every reader must meet
targets/       one module for each reader, which gives it the bytes of an input
mutations.py   random damage of inputs
corpus.py      the stored inputs in tests/corpus
execute.py     run a target with an input, within limits of time and memory
guided.py      fuzz one target with coverage guidance
__main__.py    `python -m tests.fuzz`: fuzz all targets for a given time
keep.py        select the inputs in tests/corpus again
"""
