"""Mininet's half of `benchmarks.lab`: hosts on one Linux bridge, up and down again, once.

Run by Debian's own Python as first process of private namespaces, so that whatever Mininet leaves behind ends with this
process. Prints the seconds that `build` and `start` took, and those of `stop`, as JSON; the import is not counted.
"""

import json
import os
import resource
import subprocess
import sys
import time

from mininet.net import Mininet
from mininet.nodelib import LinuxBridge
from mininet.topo import SingleSwitchTopo


def main(hosts: int) -> None:
    if os.getpid() != 1:
        sys.exit("Run python -m benchmarks.lab --mininet: it starts this in a private network.")
    subprocess.run(["mount", "-t", "sysfs", "sysfs", "/sys"], check=True)  # that of this network; brctl looks there
    # What Mininet would do first: raise limits, here of this process alone, for its own way changes the machine's.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    Mininet.inited = True
    network = Mininet(SingleSwitchTopo(hosts), switch=LinuxBridge, controller=None, build=False)
    start = time.perf_counter()
    network.build()
    network.start()
    up = time.perf_counter()
    network.stop()
    json.dump({"up_s": up - start, "down_s": time.perf_counter() - up}, sys.stdout)


if __name__ == "__main__":
    main(int(sys.argv[1]))
