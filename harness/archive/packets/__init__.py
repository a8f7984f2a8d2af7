"""What crossed the air: captures of several vehicles put together, each datagram with who received it and who did not.

`pcap` and `datagram` read frames, `capture` one file and `files` all of them; `transmissions` joins what they saw,
`exchanges` finds the responses to each request, `story` the life of a block, `losses` counts; `text` and `document`
tell it to people and to programs.
"""
