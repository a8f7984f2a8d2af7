"""Use floating point and vector registers while signals and child processes interrupt the program. Print the
results.
"""

import hashlib
import math
import os
import signal
import sys
import threading

THREADS, ROUNDS = 8, 60
interruptions = 0
results: dict[int, str] = {}


def interrupt(number: int, frame: object) -> None:
    global interruptions
    interruptions += 1
    hashlib.sha512(bytes(5000)).digest()


def work(number: int) -> str:
    data = bytes(range(256)) * 64
    digest = hashlib.sha256(str(number).encode())
    for round_ in range(ROUNDS):
        data = data[number + 1 :] + data[: number + 1]
        for name in ("sha256", "sha512", "md5", "blake2b"):
            digest.update(hashlib.new(name, data).digest())
        digest.update(bytearray(data).replace(b"\x07", b"\x08\x09"))
        digest.update(math.fsum(math.sin(round_ + value) / (value + 1) for value in range(200)).hex().encode())
    return digest.hexdigest()


def thread(number: int) -> None:
    results[number] = work(number)


signal.signal(signal.SIGALRM, interrupt)
signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
threads = [threading.Thread(target=thread, args=(number,)) for number in range(THREADS)]
for one in threads:
    one.start()
for number in range(3):
    reader, writer = os.pipe()
    if (pid := os.fork()) == 0:
        signal.setitimer(signal.ITIMER_REAL, 0.005, 0.005)
        os.write(writer, work(100 + number).encode())
        os._exit(0)
    results[100 + number] = os.read(reader, 64).decode()
    os.waitpid(pid, 0)
for one in threads:
    one.join()
signal.setitimer(signal.ITIMER_REAL, 0)
assert interruptions > 0
sys.stdout.writelines(f"{number} {result}\n" for number, result in sorted(results.items()))
