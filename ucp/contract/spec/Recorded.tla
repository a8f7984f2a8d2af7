------------------------------ MODULE Recorded -----------------------------
(***************************************************************************)
(* Are these records of agents' lives such as chapter 3 allows?  A record  *)
(* is what happened to one agent: its handler runs, one after another,     *)
(* each with its input, with what changed and with what was sent.  The     *)
(* agent of UCP.tla is given the inputs, and must do the same.             *)
(*                                                                         *)
(* Hashes, timestamps and chain hashes are numbers in a record, in the     *)
(* order of what they stand for: its writer has hashed the blocks.         *)
(***************************************************************************)
EXTENDS Integers, Sequences, FiniteSets, TLC, Lives
\* The module Lives is written for the records that are to be looked at.  It has
\*   Records:     <<[id, whole, steps], ...>>; whole: nothing is missing at its end
\*   Successors:  of each chain hash <<block hash, chain hash on top of it, ...>>

CONSTANTS
    SizeMaxEvent, SizeMaxBlock, FinalizeGap, VoteNamesChain, ChangedBeforeTally, Phase1TiePops, Phase2TieTakesBlock

VARIABLES
    record,      \* which of them
    line,        \* how many of its steps have been looked at
    agent        \* as it is then, if it does what chapter 3 says

UnknownHash == -2

\* Eq. 3.2, as far as anybody has computed it.
OnTop(below, hash) ==
    LET known == IF below \in DOMAIN Successors THEN Successors[below] ELSE <<>>
        places == {i \in DOMAIN known : i % 2 = 1 /\ known[i] = hash}
    IN IF places = {} THEN UnknownHash ELSE known[1 + CHOOSE i \in places : TRUE]

\* A timer that the running handler has started has 2, and one that was active before has 1.
Started == 2
DurationOf(id, t) == IF t = "finalize gap" /\ ~FinalizeGap THEN 0 ELSE Started

INSTANCE UCP WITH H <- OnTop, InceptionChainHash <- 1, Duration <- DurationOf, AsPrinted <- {}

---------------------------------------------------------------------------
(* How records are written: numbers in the place of words                  *)

TimerNames == <<"voting", "phase one", "phase two", "phase three", "finalize gap">>
Block(hash, timestamp, id) == [hash |-> hash, timestamp |-> timestamp, agentID |-> id]

Message(m) ==
    CASE m[1] = 1 -> [type |-> "Block Add Request", blockHash |-> m[2], chainHash |-> m[3]]
      [] m[1] = 2 -> [type |-> "Block Add Response", blockHash |-> m[2], approve |-> m[3] = 1, chainHash |-> m[4]]
      [] m[1] = 3 -> [type |-> "Commit Block", chainHash |-> m[2], block |-> Block(m[3], m[4], m[5])]
      [] m[1] = 4 -> [type |-> "Chain Contain Query", chainHash |-> m[2]]
      [] m[1] = 5 -> [type |-> "Chain Contain Response", chainHash |-> m[2], yes |-> m[3] = 1]
      [] m[1] = 6 -> [type |-> "Chain Hash Successor Query", chainHash |-> m[2]]
      [] m[1] = 7 -> [type |-> "Next in Sequence Response", chainHash |-> m[2], blockHash |-> m[3],
                      timestamp |-> m[4]]
      [] m[1] = 8 -> [type |-> "Request for Block", blockHash |-> m[2]]
      [] m[1] = 9 -> [type |-> "Block Response", block |-> Block(m[2], m[3], m[4])]

\* Which Algorithm is for what.
OfMessage == <<3, 4, 6, 9, 10, 13, 14, 17, 18>>
OfTimer == <<5, 11, 15, 19, 20>>
OfLocalEvent(event) ==
    CASE event = "Process Next Deque Block" -> 2
      [] event = "Reconcile Begin" -> 7
      [] event = "Reconcile Phase 1" -> 8
      [] event = "Reconcile Phase 2" -> 12
      [] event = "Reconcile Phase 3" -> 16
      [] event = "Reconcile Finalize" -> 20

\* What a step says: its Algorithm, input, changes, messages, timers, tally, and the state after it.
Algorithm(step) == step[1]
Kind(step) == step[2][1]
Input(step) == Tail(step[2])
Changes(step) == step[3]
Sent(step) == [i \in DOMAIN step[4] |-> Message(step[4][i])]
TimersStarted(step) == {step[5][i] : i \in DOMAIN step[5]}   \* {0}: it does not say
Tally(step) == step[6]
State(step) == step[7]

Heard == 1
TimerEnded == 2
Logged == 3
Triggered == 4
Asked == 5
Booted == 6

---------------------------------------------------------------------------
(* What the agent does at a step                                           *)

\* What it was found to hold in its store, each as flat blocks: completed, chain, deque and stack.
Flat(blocks) == [i \in 1 .. Len(blocks) \div 3 |-> Block(blocks[3 * i - 2], blocks[3 * i - 1], blocks[3 * i])]
RECURSIVE CommitAll(_, _)
CommitAll(a, blocks) == IF blocks = <<>> THEN a ELSE CommitAll(Commit(a, Head(blocks)), Tail(blocks))
Restored(id, found) ==
    [CommitAll(Fresh(id), Flat(found[2])) EXCEPT !.completed = Flat(found[1]),
                                                 !.blocksToBeCommittedDeque = Flat(found[3]),
                                                 !.reconcileStack = Flat(found[4]),
                                                 !.reconcileInProgress = TRUE]

Ready(a) == [a EXCEPT !.sent = <<>>, !.timer = [t \in Timers |-> IF @[t] > 0 THEN 1 ELSE 0]]

\* Which Algorithm runs now; 0 if none can.
Runs(a, step) ==
    LET in == Input(step) IN
    CASE a.triggered # <<>> -> IF Kind(step) = Triggered THEN OfLocalEvent(Head(a.triggered)) ELSE 0
      [] a.triggered = <<>> /\ Kind(step) = Heard -> OfMessage[in[2]]
      [] a.triggered = <<>> /\ Kind(step) = TimerEnded -> IF Active(a, TimerNames[in[1]]) THEN OfTimer[in[1]] ELSE 0
      [] a.triggered = <<>> /\ Kind(step) = Logged -> 1
      [] a.triggered = <<>> /\ Kind(step) = Asked -> 7
      [] a.triggered = <<>> /\ Kind(step) = Booted -> 20
      [] a.triggered = <<>> /\ Kind(step) = Triggered -> 0

Does(a, step) ==
    LET in == Input(step) IN
    CASE Kind(step) = Heard -> Receive(a, in[1], Message(Tail(in)))
      [] Kind(step) = TimerEnded -> Expire(a, TimerNames[in[1]])
      [] Kind(step) = Logged -> BuildDataBlock(a, [size |-> in[1], block |-> Block(in[2], in[3], in[4])])
      [] Kind(step) = Triggered -> RunNext(a)
      [] Kind(step) = Asked -> ReconcileBegin(a)
      [] Kind(step) = Booted -> ReconcileFinalize(Restored(a.id, in))

---------------------------------------------------------------------------
(* What the record says that it did                                        *)

Hashes(blocks) == [i \in DOMAIN blocks |-> blocks[i].hash]
Held(a) ==
    [completed |-> Hashes(a.completed), chain |-> Hashes(Blocks(a.blockChain)),
     deque |-> Hashes(a.blocksToBeCommittedDeque), stack |-> Hashes(a.reconcileStack)]

Removed(s, hash) ==
    LET places == {i \in DOMAIN s : s[i] = hash}
    IN IF places = {} THEN <<UnknownHash>> ELSE Without(s, CHOOSE i \in places : \A j \in places : j <= i)

\* What is held after these changes: <<operation, block hash, ...>>.
RECURSIVE Changed(_, _)
Changed(held, changes) ==
    IF changes = <<>> THEN held
    ELSE LET hash == changes[2]
             after == CASE changes[1] = 1 -> [held EXCEPT !.completed = Append(@, hash)]
                        [] changes[1] = 2 -> [held EXCEPT !.chain = Append(@, hash)]
                        [] changes[1] = 3 -> [held EXCEPT !.chain = Removed(@, hash)]
                        [] changes[1] = 4 -> [held EXCEPT !.deque = Append(@, hash)]
                        [] changes[1] = 5 -> [held EXCEPT !.deque = Removed(@, hash)]
                        [] changes[1] = 6 -> [held EXCEPT !.stack = Append(@, hash)]
                        [] changes[1] = 7 -> [held EXCEPT !.stack = Removed(@, hash)]
         IN Changed(after, SubSeq(changes, 3, Len(changes)))

AsNumber(truth) == IF truth THEN 1 ELSE 0
StateOf(a) ==
    <<Len(a.blockChain), Len(a.blocksToBeCommittedDeque), Len(a.reconcileStack), AsNumber(a.reconcileInProgress),
      AsNumber(Idle(a)), TopChainHash(a)>>

Triples(flat) ==
    {[blockHash |-> flat[3 * i - 2], count |-> flat[3 * i - 1], timestamp |-> flat[3 * i]]
        : i \in 1 .. Len(flat) \div 3}
TallyIsRight(a, tally) ==
    CASE tally = <<>> -> TRUE
      [] tally # <<>> ->
            LET told == Tail(tally) IN
            CASE tally[1] = 1 -> told = <<a.voteCount.yes, a.voteCount.no>>
              [] tally[1] = 2 -> told = <<a.reconcileVoteCount.yes, a.reconcileVoteCount.no>>
              [] tally[1] = 3 -> Triples(told) = a.reconcileResponseDictionary
              [] tally[1] = 4 -> told = <<a.majorityResponseBlockHash>>

\* Of what the record says something else than what the agent has done.
Differences(before, after, step) ==
    LET started == {i \in 1 .. 5 : after.timer[TimerNames[i]] = Started}
        differs == [what \in {"what changed", "what was sent", "which timers were started", "the tally",
                              "the state after it"} |->
            CASE what = "what changed" ->
                    IF Changes(step) = <<>> THEN Held(after) # Held(before)
                    ELSE Held(after) # Changed(Held(before), Changes(step))
              [] what = "what was sent" -> after.sent # Sent(step)
              [] what = "which timers were started" -> TimersStarted(step) # {0} /\ TimersStarted(step) # started
              [] what = "the tally" -> ~TallyIsRight(after, Tally(step))
              [] what = "the state after it" -> StateOf(after) # State(step)]
    IN {what \in DOMAIN differs : differs[what]}

---------------------------------------------------------------------------
(* One record after another; of each up to the first difference            *)

Begin(r) == IF r > Len(Records) THEN Fresh(0) ELSE Fresh(Records[r].id)
Init == record = 1 /\ line = 0 /\ agent = Begin(1)

NextRecord == record' = record + 1 /\ line' = 0 /\ agent' = Begin(record + 1)
Rejected(number, what) == PrintT(<<"rejected", record, number, what>>) /\ NextRecord

AtEnd ==
    /\ record <= Len(Records)
    /\ line = Len(Records[record].steps)
    /\ IF Records[record].whole /\ agent.triggered # <<>>
       THEN Rejected(line, {"what it triggered has yet to run"})
       ELSE NextRecord

Step ==
    /\ record <= Len(Records)
    /\ line < Len(Records[record].steps)
    /\ LET step == Records[record].steps[line + 1]
           before == Ready(agent)
       IN IF Runs(before, step) # Algorithm(step)
          THEN Rejected(line + 1, {"which handler runs"})
          ELSE LET after == Does(before, step)
                   differences == Differences(before, after, step)
               IN IF differences # {} THEN Rejected(line + 1, differences)
                  ELSE record' = record /\ line' = line + 1 /\ agent' = after

Spec == Init /\ [][AtEnd \/ Step]_<<record, line, agent>>

\* No two states have the same.
Position == <<record, line>>
=============================================================================
