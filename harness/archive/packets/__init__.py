"""The datagrams of a run, joined from the captures of several vehicles, with the receivers and the losses of each.

`pcap` and `datagram` read frames, `capture_reader` reads one file, and `capture_files` reads all files of a mission.
`transmissions` joins the sightings of each datagram. `exchanges` finds the responses to each request, and counts
losses. `selection` filters, `packets_text` writes text, and `packets_document` writes JSON.
"""
