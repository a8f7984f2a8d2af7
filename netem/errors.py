"""The errors of this package. Each message is a sentence that says what to do."""

from __future__ import annotations


class NetemError(Exception):
    """Base class of all errors that `netem` raises for its callers."""


class ConditionsError(NetemError, ValueError):
    """Invalid conditions. The message names the key, the value and the allowed values."""


class NetlinkError(NetemError):
    """The kernel refused a netlink request. `errno` and the message come from the kernel."""

    def __init__(self, message: str, errno: int) -> None:
        super().__init__(message)
        self.errno = errno


class EngineError(NetemError):
    """An engine could not be used, or the kernel refused a change of conditions."""


class LabError(NetemError):
    """The lab failed, or a request to it failed."""


class LabUnavailable(LabError):  # noqa: N818  (a state of the machine)
    """This machine cannot run the lab or the requested engine. `way_out` is the remedy."""

    def __init__(self, reason: str, way_out: str, stage: str = "namespaces") -> None:
        super().__init__(f"{reason.rstrip('.')}. {way_out}")
        self.reason = reason
        self.way_out = way_out
        self.stage = stage  # "namespaces", "fabric" or "engine": the step that failed


class SpawnError(LabError):
    """A program could not be started in the lab. The message contains that of the operating system."""


class UmlError(NetemError):
    """User Mode Linux is missing, did not boot, hung or panicked."""


class LiveCaptureError(NetemError):
    """A capture of packets failed to start, or ended early."""
