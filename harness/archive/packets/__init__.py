"""Combine the packet captures of several vehicles, to find the receivers and losses of each datagram.

`pcap` and `datagram` read frames, `capture_reader` reads one file, and `capture_files` reads all files of a mission.
`transmissions` joins the sightings of each datagram. `exchanges` finds the responses to each request, and counts
losses. `selection` filters, `packets_text` writes text, and `packets_document` writes JSON.
"""
