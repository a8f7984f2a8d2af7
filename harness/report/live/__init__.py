"""Serve a web page that shows a run: live while the run is active, or as a film afterwards.

`harness.report.live.feed` turns the files of a run (`network.jsonl`, `tracks.jsonl`, the agents' traces) into one
stream of changes. During the run the feed follows the growing files. After the run it reads them to the end. In both
cases the page receives the same stream. The agents do no additional work for the page, and the run never waits for the
page.
"""
