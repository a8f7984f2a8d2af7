"""The errors of this package. Each message is one sentence with a solution."""

from __future__ import annotations


class NetemError(Exception):
    """The base class of all errors that the package `netem` raises."""


class ConditionsError(NetemError, ValueError):
    """An error: network conditions are invalid. The message names the key, the value and the allowed values."""


class NetlinkError(NetemError):
    """An error: the kernel refused a netlink request. `errno` and the message come from the kernel."""

    def __init__(self, message: str, errno: int) -> None:
        super().__init__(message)
        self.errno = errno


class EngineError(NetemError):
    """An error: an engine cannot be used, or the kernel refused a change of network conditions."""


class LabError(NetemError):
    """An error: the virtual network failed, or a request to it failed."""


class LabUnavailable(LabError):  # noqa: N818  (a state of the machine)
    """An error: this machine cannot run the virtual network or the requested engine. `way_out` is the
    remedy.
    """

    def __init__(self, reason: str, way_out: str, stage: str = "namespaces") -> None:
        super().__init__(f"{reason.rstrip('.')}. {way_out}")
        self.reason = reason
        self.way_out = way_out
        self.stage = stage  # "namespaces", "fabric" or "engine": the step that failed


class SpawnError(LabError):
    """An error: a program could not be started in the virtual network. The error includes the message of the operating
    system.
    """


class UmlError(NetemError):
    """An error: User Mode Linux is missing, did not boot, hung or crashed."""


class LiveCaptureError(NetemError):
    """An error: a packet capture could not be started, or ended before it was stopped."""
