"""Fuzz tests of all readers of external input. With `atheris`, coverage guides the mutations; without, they are random.

finding.py     the conditions that every reader must meet
targets/       one module for each reader, which gives it the bytes of an input
mutations.py   random damage of inputs
corpus.py      the stored inputs in tests/corpus
execute.py     run a target with an input, within limits of time and memory
guided.py      fuzz one target with coverage guidance
__main__.py    `python -m tests.fuzz`: fuzz all targets for a given time
keep.py        select the inputs in tests/corpus again
"""
