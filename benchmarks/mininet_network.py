"""Start and stop Mininet hosts on one Linux bridge, once, for `benchmarks.lab`.

`benchmarks.lab` runs it with Debian's own Python as the first process of private namespaces, so that everything that
Mininet leaves behind ends with this process. The program prints as JSON the seconds that Mininet takes for `build` and
`start` together, and for `stop`. The time of the import is not counted.
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
