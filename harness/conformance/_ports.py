"""Sockets of the lab, for who is outside: `python -m harness.conformance._ports SOCKET PORT...` in a vehicle's network.

It binds a UDP socket to each port, hands all of them over through the Unix socket SOCKET, and ends. A socket stays in
the network that it was made in.
"""

import socket
import sys
from collections.abc import Sequence

AT_ONCE = 100
"""Descriptors in one message; Linux carries 253."""


def main(arguments: Sequence[str]) -> None:
    path, *ports = arguments
    sockets = []
    for port in ports:
        air = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        air.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        air.bind(("", int(port)))
        sockets.append(air)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as to:
        to.connect(path)
        for first in range(0, len(sockets), AT_ONCE):
            some = sockets[first : first + AT_ONCE]
            socket.send_fds(to, [bytes([len(some)])], [air.fileno() for air in some])


if __name__ == "__main__":
    main(sys.argv[1:])
