"""An implementation of the Uniform Chain Protocol: blocks, chain, messages, and the 20 event handlers of Algorithms
1-20.

`__all__` lists the public names. Python imports a public name only when a program first uses it. An agent process
therefore imports only the modules that it needs, and starts faster.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ucp.agent import Agent
    from ucp.block import Block, InceptionBlock
    from ucp.chain import Chain
    from ucp.events import LoggableEvent, decode_events
    from ucp.export import export_chain
    from ucp.messages import (
        BlockAddRequest,
        BlockAddResponse,
        BlockResponse,
        ChainContainQuery,
        ChainContainResponse,
        ChainHashSuccessorQuery,
        CommitBlock,
        Datagram,
        MalformedDatagramError,
        NextInSequenceResponse,
        RequestForBlock,
        decode,
        encode,
    )
    from ucp.settings import Settings
    from ucp.trace import HandlerRun
    from ucp.trigger import (
        BootTrigger,
        EventTrigger,
        LocalTrigger,
        MessageTrigger,
        OperatorTrigger,
        TimerTrigger,
        Trigger,
    )

__all__ = [
    "Agent",
    "Block",
    "BlockAddRequest",
    "BlockAddResponse",
    "BlockResponse",
    "BootTrigger",
    "Chain",
    "ChainContainQuery",
    "ChainContainResponse",
    "ChainHashSuccessorQuery",
    "CommitBlock",
    "Datagram",
    "EventTrigger",
    "HandlerRun",
    "InceptionBlock",
    "LocalTrigger",
    "LoggableEvent",
    "MalformedDatagramError",
    "MessageTrigger",
    "NextInSequenceResponse",
    "OperatorTrigger",
    "RequestForBlock",
    "Settings",
    "TimerTrigger",
    "Trigger",
    "decode",
    "decode_events",
    "encode",
    "export_chain",
]

_NAMES_OF = {
    "ucp.agent": ("Agent",),
    "ucp.block": ("Block", "InceptionBlock"),
    "ucp.chain": ("Chain",),
    "ucp.events": ("LoggableEvent", "decode_events"),
    "ucp.export": ("export_chain",),
    "ucp.messages": (
        "BlockAddRequest",
        "BlockAddResponse",
        "BlockResponse",
        "ChainContainQuery",
        "ChainContainResponse",
        "ChainHashSuccessorQuery",
        "CommitBlock",
        "Datagram",
        "MalformedDatagramError",
        "NextInSequenceResponse",
        "RequestForBlock",
        "decode",
        "encode",
    ),
    "ucp.settings": ("Settings",),
    "ucp.trace": ("HandlerRun",),
    "ucp.trigger": (
        "BootTrigger",
        "EventTrigger",
        "LocalTrigger",
        "MessageTrigger",
        "OperatorTrigger",
        "TimerTrigger",
        "Trigger",
    ),
}
"""Module -> its public names. Python imports the module when a program first uses one of these names."""
_MODULE_OF = {name: module for module, names in _NAMES_OF.items() for name in names}

if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        return getattr(import_module(_MODULE_OF[name]), name)

    def __dir__() -> list[str]:
        return __all__
