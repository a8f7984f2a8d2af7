"""Describe a step, a state or a difference as text. Most descriptions are one line of at most 100 columns."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest

from rich.table import Table
from rich.text import Text

from harness.checker.recorded_inputs import decoded
from harness.checker.steps.deviation import StepDeviation
from harness.field.replay._agent_record import RecordEntry
from harness.field.replay._player import RecordPlayer
from harness.field.replay.breakpoints import source_of
from harness.field.replay.replay_names import SHOWN, ReplayNames
from harness.present.text import shown
from ucp.agent import HANDLERS
from ucp.block import Block
from ucp.events import MalformedEventsError, decode_events
from ucp.messages import BlockResponse, CommitBlock, MalformedDatagramError, Message
from ucp.trace import DroppedDatagram, HandlerRun, RecordedBytes, SentMessage
from ucp.trigger import BootTrigger, EventTrigger, LocalTrigger, MessageTrigger, OperatorTrigger, TimerTrigger

BLOCKS_SHOWN = 8


class StepText:
    """An object that describes the steps and states of a replay as text. `names` contains the names of the blocks in
    the record.
    """

    def __init__(self, player: RecordPlayer, names: ReplayNames) -> None:
        self._player = player
        self._names = names

    # A step

    def line(self, number: int, entry: RecordEntry) -> Text:
        """Return the line for entry number `number` (from 1), such as "212 604.278 s A18
        receive_response_block_for_hash: committed".
        """
        where = f"{entry.line:>7} {entry.content.t:>10.3f} s  "
        match entry.content:
            case HandlerRun() as run:
                text = f"A{run.algorithm:<3}{run.handler[:40]}: {run.branch[:40]}"
            case DroppedDatagram() as entry_content:
                text = f"    dropped a datagram: {entry_content.dropped[:60]}"
            case entry_content:
                text = f"    command {entry_content.command[:40]}"
        differs = number in self._player.result.positions
        return shown(f"{'✘' if differs else ' '}{where}{text}", style="red" if differs else "")

    def step(self) -> Iterator[Text]:
        """Yield lines of text about the last step: its trigger, the rule of its Algorithm, its effects and its
        deviations.
        """
        player = self._player
        entry = player.entry
        if entry is None:
            yield shown(f"before line 1: agent {player.record.agent_id} as it begins", style="bold")
            return
        incarnation = f", life {entry.incarnation}" if player.record.incarnations > 1 and entry.incarnation else ""
        place = f"line {entry.line}{incarnation}, t={entry.content.t:.3f} s"
        if entry.gap is not None:
            yield shown(f"before this {entry.gap}", style="yellow")
        match entry.content:
            case HandlerRun() as run:
                yield from self._run(run, place)
            case DroppedDatagram() as entry_content:
                yield shown(f"{place}: dropped, {entry_content.dropped[:60]}", style="bold")
                yield _row("came", self._datagram(entry_content.datagram))
            case entry_content:
                yield shown(f"{place}: command {entry_content.command[:60]}", style="bold")
        for deviation in player.deviations_here():
            yield self.deviation(deviation)
        if player.lost is not None:
            yield shown(f"  - {player.lost}", style="yellow")

    def _run(self, run: HandlerRun, place: str) -> Iterator[Text]:
        handler = HANDLERS.get(run.handler)
        source = f"  {source_of(handler.name)}" if handler else ""
        yield shown(f"{place}: Algorithm {run.algorithm}, {run.handler[:60]}", style="bold").append(
            source, "not bold dim"
        )
        yield _row("because", self._trigger(run))
        if handler:
            yield _row("rule", _first_line(handler.run.__doc__), "dim")
        yield _row("branch", run.branch[:80])
        if run.changes:
            changes = (f"{operation} {self._names.of(block)}" for operation, block in run.changes)
            yield _row("changed", _first_words(changes, len(run.changes)))
        for sent in run.sent[:BLOCKS_SHOWN]:
            yield _row("sent", self.sent(sent))
        if run.started:
            yield _row("started", ", ".join(f"{timer[:40]} for {length:g} s" for timer, length in run.started.items()))
        if run.tally:
            yield _row("counted", ", ".join(self._counted(key, count) for key, count in run.tally.items()))

    def deviation(self, deviation: StepDeviation) -> Text:
        """Return the line about a deviation. If the deviation belongs to an earlier step, the line names this step."""
        entry = self._player.entry
        own = entry is not None and entry.line == deviation.line and isinstance(entry.content, HandlerRun)
        whose = "" if own else f"of line {deviation.line}, {deviation.handler}: "
        return shown(f"  ✘ {whose}{deviation.difference(self._names.of)}", style="bold red")

    def side_by_side(self, deviation: StepDeviation) -> Table | Text:
        """Return a table of the recorded step and the step of the reference. Differences are marked."""
        if deviation.run is None or deviation.expected is None:
            return self.deviation(deviation)
        table = Table("", "the agent's record", "the reference", box=None, padding=(0, 2, 0, 0))
        for label, own, right in self._compared_parts(deviation.run, deviation.expected):
            style = "" if own == right else "red"
            table.add_row(label, shown(own, style), shown(right, style))
        return table

    def _compared_parts(self, *runs: HandlerRun) -> Iterator[tuple[str, str, str]]:
        own, right = runs
        yield "branch", own.branch, right.branch
        changes = ([f"{operation} {self._names.of(block)}" for operation, block in run.changes] for run in runs)
        yield from _paired("changed", *changes)
        yield from _paired("sent", *([self.sent(sent) for sent in run.sent] for run in runs))
        yield from _paired(
            "started", *([f"{timer} {s:g} s" for timer, s in (run.started or {}).items()] for run in runs)
        )
        counted = ([self._counted(key, count) for key, count in (run.tally or {}).items()] for run in runs)
        yield from _paired("counted", *counted)
        for content in ("chain", "deque", "stack", "reconciling", "idle"):
            yield content, str(getattr(own.state, content)), str(getattr(right.state, content))
        yield "top", own.state.top[:SHOWN], right.state.top[:SHOWN]

    def _trigger(self, run: HandlerRun) -> str:
        match run.trigger:
            case MessageTrigger(name, sender, sequence):
                return f"{name[:60]} {sequence} of agent {sender}: {self._datagram(run.input)}"
            case TimerTrigger(name):
                return f"the {name[:60]} timer expired"
            case LocalTrigger(handler):
                return f"triggered by {handler[:60]}"
            case EventTrigger(event_id):
                return f"the vehicle logged event {event_id}"
            case OperatorTrigger(command):
                return f"the operator asked: {command[:60]}"
            case BootTrigger(blocks):
                return f"it restarted with a chain of {blocks} blocks from its disk"
        return "an unknown trigger"

    def _datagram(self, record: RecordedBytes | None) -> str:
        try:
            return self._message(decoded(record).message)
        except MalformedDatagramError as malformed:
            return f"an invalid message ({malformed.reason})"

    def _message(self, message: Message) -> str:
        if isinstance(message, CommitBlock | BlockResponse):
            block = f"block {self._names.of(message.block.block_hash.hex())}"
            return f"{block} for {self.chain(message.chain_hash)}" if isinstance(message, CommitBlock) else block
        text = []
        for field in type(message).WIRE:
            value = getattr(message, field)
            if field == "chain_hash":
                text += [self.chain(value)] if value else []
            elif field == "block_hash":
                text.append(f"block {self._names.of(value.hex())}" if value else "Is Top Of Chain")
            elif isinstance(value, bool):
                text.append("yes" if value else "no")
        return ", ".join(text)

    def chain(self, chain_hash: bytes) -> str:
        """Describe a chain hash. The text states whether the chain hash belongs to the agent's own chain."""
        chain = self._player.state.chain
        if chain_hash == chain.top_chain_hash:
            own = "our top"
        elif chain.contains_chain_hash(chain_hash):
            own = "in our chain"
        else:
            own = "not in our chain"
        return f"chain {chain_hash.hex()[:SHOWN]} ({own})"

    def sent(self, sent: SentMessage) -> str:
        return f"{sent.message[:60]} {sent.seq}: {self._datagram(sent.datagram)}"

    def _counted(self, key: str, count: object) -> str:
        if key in ("yes", "no"):
            return f"{key} {count}"
        number = count[0] if isinstance(count, list) and count else count
        return f"{self._names.of(key) if key else 'Is Top Of Chain'}: {number}"

    # The state

    def in_short(self) -> Text:
        """Return the state of the agent as text in one line."""
        if self._player.lost is not None:
            return shown("  the state of the agent is not known", style="yellow")
        state = self._player.state
        held = (
            f"chain {len(state.chain)}, deque {len(state.blocks_to_be_committed)}, stack {len(state.reconcile_stack)}"
        )
        doing = "reconciling" if state.reconcile_in_progress else "idle" if state.idle else "voting"
        timers = "".join(f", {text}" for text in self._timers())
        return shown(f"  {held}, {doing}{timers}", style="cyan")

    def state(self) -> Iterator[Text]:
        """Yield lines about the complete state of the agent after the step."""
        if self._player.lost is not None:
            yield self.in_short()
            return
        state = self._player.state
        yield _row(
            "chain", f"{self._blocks(list(state.chain))}; top chain hash {state.chain.top_chain_hash.hex()[:SHOWN]}"
        )
        yield _row("deque", self._blocks(list(state.blocks_to_be_committed), last=False))
        yield _row("stack", self._blocks(state.reconcile_stack))
        yield _row("current", _events(bytes(state.current_block)))
        yield _row("timers", ", ".join(self._timers()) or "none runs")
        if state.candidate_block is not None:
            votes = ", ".join(f"{vote} {count}" for vote, count in state.vote_count.items())
            on = f"{self._names.of(state.candidate_block.block_hash.hex())} on "
            on += self.chain(state.top_chain_hash_at_initiation)
            whose = f"; counted agents {_ids(state.voters)} and itself" if state.voters else ""
            yield _row("vote" if state.voting_timer.active else "last vote", f"{on}: {votes}{whose}")
        if state.reconcile_in_progress:
            votes = ", ".join(f"{vote} {count}" for vote, count in state.reconcile_vote_count.items())
            yield _row("phase 1", votes)
            candidates = (
                f"{self._names.of(candidate.hex()) if candidate else 'Is Top Of Chain'} {counted[0]}"
                for candidate, counted in state.reconcile_response_dictionary.items()
            )
            yield _row("phase 2", ", ".join(candidates) or "no candidate")
            asked = state.majority_response_block_hash
            yield _row("phase 3", f"block {self._names.of(asked.hex())}" if asked else "no block chosen")
            if state.reconcile_responders:
                yield _row("answered", f"agents {_ids(state.reconcile_responders)}")
        for event, by in state.triggered:
            yield _row("next", f"{event}, triggered by {by}")
        flags = ["reconcile in progress"] if state.reconcile_in_progress else []
        yield _row("flags", ", ".join([*flags, "idle" if state.idle else "not idle"]))

    def _timers(self) -> Iterator[str]:
        state = self._player.state
        for timer in state.timers:
            if timer.deadline is not None:
                yield f"{timer.name} {timer.deadline - state.now:.3g} s left"
            elif timer.active:
                yield f"{timer.name} paused"

    def _blocks(self, blocks: Sequence[Block], last: bool = True) -> str:
        if not blocks:
            return "none"
        shown = blocks[-BLOCKS_SHOWN:] if last else blocks[:BLOCKS_SHOWN]
        names = " ".join(self._names.of(block.block_hash.hex()) for block in shown)
        if len(shown) == len(blocks):
            return f"{len(blocks)}: {names}"
        return f"{len(blocks)}: … {names}" if last else f"{len(blocks)}: {names} …"


def _row(label: str, text: str, style: str = "") -> Text:
    return shown(f"  {label:<10}", style="dim").append(
        shown(text, style=f"not dim {style}" if style != "dim" else "dim")
    )


def _paired(label: str, own: list[str], right: list[str]) -> Iterator[tuple[str, str, str]]:
    for number, (of_own, of_right) in enumerate(zip_longest(own, right, fillvalue="nothing")):
        yield label if not number else "", of_own, of_right


def _first_words(text: Iterable[str], count: int) -> str:
    shown = [word for word, _ in zip(text, range(BLOCKS_SHOWN), strict=False)]
    more = f" and {count - len(shown)} more" if count > len(shown) else ""
    return ", ".join(shown) + more


def _first_line(docstring: str | None) -> str:
    return (docstring or "").strip().partition("\n")[0]


def _events(current_block: bytes) -> str:
    try:
        count = len(decode_events(current_block))
    except MalformedEventsError:
        return f"{len(current_block)} bytes"
    return f"{count} event{'s' if count != 1 else ''}, {len(current_block)} bytes"


def _ids(agents: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(agents)))
