"""Combine the packet captures of several vehicles, to find the receivers and losses of each datagram.

`pcap` and `datagram` read frames, `capture_reader` reads one file, and `capture_files` reads all files of a mission.
`transmissions` combines the occurrences of each datagram in all captures. `exchanges` finds the responses to each
request, counts losses and filters messages. `packets_document` writes JSON.
"""
