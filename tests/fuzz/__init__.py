"""Hostile input for all that reads any: mutated at random, or under coverage guidance where `atheris` is installed.

finding.py     what no reader may do
targets/       one for each reader: bytes go in, and what may not happen is an exception
mutations.py   damages files as the field does
corpus.py      the inputs that are kept, in tests/corpus
execute.py     an input through a target, within bounds
guided.py      one target under coverage guidance
__main__.py    `python -m tests.fuzz`: all targets, for as long as one likes
keep.py        makes tests/corpus anew
"""
