"""Process story files. A story is a text of events in a mission, with the reactions of the agents below each event.

`story_file` reads and rewrites the files, and `sentences` defines the events. `narration` writes the reactions from the
agents' traces, with names from `story_names`. A story needs only traces, so it can test agents in any language.
"""
