"""Open sockets inside the virtual network, and pass them to the harness outside: `python -m harness.conformance._ports
SOCKET PORT...`.

The program runs in the network namespace of a vehicle. It binds a UDP socket to each port, passes all of them to the
harness through the Unix socket SOCKET, and ends. The harness can then use the sockets, because a socket always belongs
to the namespace in which it was opened.
"""

import socket
import sys
from collections.abc import Sequence

MAX_DESCRIPTORS = 100
"""Maximum number of file descriptors in one message. The limit of Linux is 253."""


def main(arguments: Sequence[str]) -> None:
    path, *ports = arguments
    sockets = []
    for port in ports:
        udp_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp_socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        udp_socket.bind(("", int(port)))
        sockets.append(udp_socket)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as to:
        to.connect(path)
        for first in range(0, len(sockets), MAX_DESCRIPTORS):
            some = sockets[first : first + MAX_DESCRIPTORS]
            socket.send_fds(to, [bytes([len(some)])], [udp_socket.fileno() for udp_socket in some])


if __name__ == "__main__":
    main(sys.argv[1:])
