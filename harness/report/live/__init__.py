"""A run to look at: a page in the browser while it goes on, and the same page as a film once it is over.

What a run has taken down (`network.jsonl`, `tracks.jsonl`, the agents' traces) becomes one stream of changes
(`harness.report.live.feed`). A live run is its files while they grow, a film the same files read to their end: the
page does not know one from the other. Agents do nothing for it, and a run does not wait for it.
"""
