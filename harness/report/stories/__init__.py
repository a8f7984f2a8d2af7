"""Process stories: text files that contain events and, below each event, the reactions of the agents.

`story_file` reads and rewrites the files, and `sentences` defines the events. `narration` makes the reactions from the
agents' traces, with names from `story_names`. Any agent writes traces, so a story can test any agent.
"""
