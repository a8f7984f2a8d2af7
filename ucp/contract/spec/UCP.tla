-------------------------------- MODULE UCP --------------------------------
(***************************************************************************)
(* One agent of the Uniform Chain Protocol: Algorithms 1-20 of chapter 3   *)
(* of the thesis, in its order and with its names.                         *)
(*                                                                         *)
(* An operator for each event handler takes the agent as it is, and what   *)
(* triggers the handler, and gives the agent as it is afterwards.  Where   *)
(* the thesis contradicts itself, or says nothing, a comment says how it   *)
(* is read.  What it does with locks is left out: here a handler runs to   *)
(* its end, then the local events that it has triggered, then comes the    *)
(* next input.                                                             *)
(***************************************************************************)
EXTENDS Integers, Sequences, FiniteSets

CONSTANTS
    H(_, _),              \* Eq. 3.2: chain hash of the block below, block hash |-> chain hash
    InceptionChainHash,   \* CH_0, eq. 3.4
    Duration(_, _),       \* what a timer counts down from: agent ID, timer |-> number
    SizeMaxEvent,         \* Algorithm 1
    SizeMaxBlock,
    VoteNamesChain,       \* readings with a setting, each off in the base
    ChangedBeforeTally,
    Phase1TiePops,
    Phase2TieTakesBlock,
    AsPrinted             \* Algorithms that do what is printed, where it cannot be meant; {} for UCP

---------------------------------------------------------------------------
(* 3.2 Definitions.  A hash function without collisions is one to one, so  *)
(* any names will do for hashes.  They are ordered: ties are broken.       *)

NoHash == -1
IsTopOfChain == 0         \* stands where block hashes stand, and is lower than any
NoBlock == [hash |-> NoHash, timestamp |-> -1, agentID |-> 0]

Timers == {"voting", "phase one", "phase two", "phase three", "finalize gap"}

\* blockChain: the blocks above the inception block, each with its chain hash (3.4.2), which belongs to its place.
\* timer: 0 when it is not active.  currentBlock: how much data it has.  completed: what the agent has made, for
\* characteristic 2.  sent, triggered: what its handlers have sent, and which local events have yet to run.
Fresh(id) ==
    [id |-> id,
     blockChain |-> <<>>,
     currentBlock |-> 0,
     blocksToBeCommittedDeque |-> <<>>,
     completed |-> <<>>,
     timer |-> [t \in Timers |-> 0],
     candidateBlock |-> NoBlock,
     topChainHashAtInitiation |-> NoHash,
     voteCount |-> [yes |-> 0, no |-> 0],
     voters |-> {},
     reconcileInProgress |-> FALSE,
     reconcileStack |-> <<>>,
     reconcileVoteCount |-> [yes |-> 0, no |-> 0],
     responders |-> {},
     reconcileResponseDictionary |-> {},
     majorityResponseBlockHash |-> NoHash,
     triggered |-> <<>>,
     sent |-> <<>>]

Range(s) == {s[i] : i \in DOMAIN s}
Last(s) == s[Len(s)]
Front(s) == SubSeq(s, 1, Len(s) - 1)
Without(s, i) == SubSeq(s, 1, i - 1) \o SubSeq(s, i + 1, Len(s))
Blocks(chain) == [i \in DOMAIN chain |-> chain[i].block]

TopChainHash(a) == IF a.blockChain = <<>> THEN InceptionChainHash ELSE Last(a.blockChain).chainHash
TopTimestamp(a) == IF a.blockChain = <<>> THEN 0 ELSE Last(a.blockChain).block.timestamp

\* How high in the chain the block with this chain hash is, 0 for the inception block; {} if it is not there.
Heights(a, chainHash) ==
    {i \in DOMAIN a.blockChain : a.blockChain[i].chainHash = chainHash}
        \cup (IF chainHash = InceptionChainHash THEN {0} ELSE {})

InChain(a, blockHash) == \E i \in DOMAIN a.blockChain : a.blockChain[i].block.hash = blockHash
Holds(a, blockHash) ==
    \/ InChain(a, blockHash)
    \/ \E b \in Range(a.blocksToBeCommittedDeque) \cup Range(a.reconcileStack) : b.hash = blockHash

Active(a, t) == a.timer[t] > 0
Start(a, t) == [a EXCEPT !.timer[t] = Duration(a.id, t)]
Stop(a, t) == [a EXCEPT !.timer[t] = 0]
Trigger(a, event) == [a EXCEPT !.triggered = Append(@, event)]
NetworkSend(a, message) == [a EXCEPT !.sent = Append(@, message)]
Commit(a, block) ==
    [a EXCEPT !.blockChain = Append(@, [block |-> block, chainHash |-> H(TopChainHash(a), block.hash)])]
CommitBlock(a) ==
    [type |-> "Commit Block", block |-> Last(a.blockChain).block, chainHash |-> TopChainHash(a)]

Idle(a) == ~a.reconcileInProgress /\ a.triggered = <<>> /\ \A t \in Timers : ~Active(a, t)

---------------------------------------------------------------------------
(* 3.6.1 Incorporation of Event Data into Blocks                           *)

\* Algorithm 1.  event.block is the block that comes of it if this event fills it; it has the time of its newest event
\* (4.2).  Reading: a new current block begins.
BuildDataBlock(a, event) ==
    LET size == a.currentBlock + event.size IN
    IF size + SizeMaxEvent >= SizeMaxBlock
    THEN Trigger([a EXCEPT !.currentBlock = 0,
                           !.completed = Append(@, event.block),
                           !.blocksToBeCommittedDeque = Append(@, event.block)],
                 "Process Next Deque Block")
    ELSE [a EXCEPT !.currentBlock = size]

---------------------------------------------------------------------------
(* 3.6.2 The Commit Process                                                *)

\* Algorithm 2.
ProcessNextDequeBlock(a) ==
    IF a.reconcileInProgress \/ Active(a, "voting") \/ a.blocksToBeCommittedDeque = <<>> THEN a
    ELSE LET candidate == Head(a.blocksToBeCommittedDeque)
             asking == [a EXCEPT !.voteCount = [yes |-> 1, no |-> 0],
                                 !.voters = {},
                                 !.topChainHashAtInitiation = TopChainHash(a),
                                 !.candidateBlock = candidate]
         IN NetworkSend(Start(asking, "voting"),
                        [type |-> "Block Add Request", blockHash |-> candidate.hash, chainHash |-> TopChainHash(a)])

\* Algorithm 3.
ReceiveRequestAddBlock(a, from, message) ==
    IF a.reconcileInProgress THEN a
    ELSE NetworkSend(a, [type |-> "Block Add Response", blockHash |-> message.blockHash,
                         approve |-> TopChainHash(a) = message.chainHash,
                         chainHash |-> IF VoteNamesChain THEN message.chainHash ELSE NoHash])

\* Algorithm 4.  4.1: an agent is counted once; so a vote has its responder.
ReceiveVoteAddBlock(a, from, message) ==
    IF /\ Active(a, "voting")
       /\ message.blockHash = a.candidateBlock.hash
       /\ VoteNamesChain => message.chainHash = a.topChainHashAtInitiation
       /\ from \notin a.voters
    THEN LET heard == [a EXCEPT !.voters = @ \cup {from}] IN
         IF message.approve THEN [heard EXCEPT !.voteCount.yes = @ + 1] ELSE [heard EXCEPT !.voteCount.no = @ + 1]
    ELSE a

\* Algorithm 5.  Printed: nothing happens when an approved block comes too late, as the chain has changed.  The list
\* above it and 4.3 say that there is another vote.
VoteTimerExpiration(a) ==
    LET approved == a.voteCount.yes > a.voteCount.no
        changed == TopChainHash(a) # a.topChainHashAtInitiation
    IN CASE a.reconcileInProgress -> a
         [] ~a.reconcileInProgress /\ changed /\ (approved \/ ChangedBeforeTally) ->
                IF 5 \in AsPrinted THEN a ELSE Trigger(a, "Process Next Deque Block")
         [] ~a.reconcileInProgress /\ ~approved /\ ~(changed /\ ChangedBeforeTally) ->
                Trigger(a, "Reconcile Begin")
         [] ~a.reconcileInProgress /\ ~changed /\ approved ->
                LET committed == Commit([a EXCEPT !.blocksToBeCommittedDeque = Tail(@)],
                                        Head(a.blocksToBeCommittedDeque))
                IN Trigger(NetworkSend(committed, CommitBlock(committed)), "Process Next Deque Block")

\* Algorithm 6.  3.1: no more than one copy of a block.  Only messages trigger it, whatever Figure 3.9 says: Finalize's
\* own blocks would be refused.
ReceiveCommitBlock(a, from, message) ==
    IF /\ ~a.reconcileInProgress
       /\ message.chainHash = H(TopChainHash(a), message.block.hash)
       /\ ~Holds(a, message.block.hash)
    THEN Commit(a, message.block)
    ELSE a

---------------------------------------------------------------------------
(* 3.6.3 Reconcile Process                                                 *)

\* Algorithm 7.
ReconcileBegin(a) ==
    IF a.reconcileInProgress THEN a
    ELSE Trigger([a EXCEPT !.reconcileInProgress = TRUE], "Reconcile Phase 1")

\* Algorithm 8.
ReconcilePhase1(a) ==
    LET asking == [a EXCEPT !.reconcileVoteCount = [yes |-> 0, no |-> 0], !.responders = {}]
    IN NetworkSend(Start(asking, "phase one"), [type |-> "Chain Contain Query", chainHash |-> TopChainHash(a)])

\* Algorithm 9.
ReceiveRequestChainContain(a, from, message) ==
    IF a.reconcileInProgress THEN a
    ELSE NetworkSend(a, [type |-> "Chain Contain Response", chainHash |-> message.chainHash,
                         yes |-> Heights(a, message.chainHash) # {}])

\* Algorithm 10.  4.1: once per responder.
ReceivePhase1Response(a, from, message) ==
    IF Active(a, "phase one") /\ message.chainHash = TopChainHash(a) /\ from \notin a.responders
    THEN LET heard == [a EXCEPT !.responders = @ \cup {from}] IN
         IF message.yes THEN [heard EXCEPT !.reconcileVoteCount.yes = @ + 1]
                        ELSE [heard EXCEPT !.reconcileVoteCount.no = @ + 1]
    ELSE a

\* Algorithm 11.  Everybody has the inception block: it stays.
ReconcilePhase1TimerExpiration(a) ==
    LET yes == a.reconcileVoteCount.yes
        no == a.reconcileVoteCount.no
        pops == yes < no \/ (yes = no /\ Phase1TiePops)
    IN CASE yes + no = 0 \/ (pops /\ a.blockChain = <<>>) -> Trigger(a, "Reconcile Finalize")
         [] yes + no > 0 /\ pops /\ a.blockChain # <<>> ->
                Trigger([a EXCEPT !.blockChain = Front(@),
                                  !.reconcileStack = Append(@, Last(a.blockChain).block)],
                        "Reconcile Phase 1")
         [] yes + no > 0 /\ ~pops -> Trigger(a, "Reconcile Phase 2")

\* Algorithm 12.
ReconcilePhase2(a) ==
    LET asking == [a EXCEPT !.reconcileResponseDictionary = {}, !.responders = {}]
    IN NetworkSend(Start(asking, "phase two"),
                   [type |-> "Chain Hash Successor Query", chainHash |-> TopChainHash(a)])

\* Algorithm 13.  Printed: the response's block is "Is Top Of Chain"; it stands where the block hash does.
ReceiveRequestNextInSequence(a, from, message) ==
    CASE a.reconcileInProgress -> a
      [] ~a.reconcileInProgress /\ Heights(a, message.chainHash) = {} -> Trigger(a, "Reconcile Begin")
      [] ~a.reconcileInProgress /\ Heights(a, message.chainHash) # {} ->
             LET height == CHOOSE h \in Heights(a, message.chainHash) : TRUE
                 isTop == message.chainHash = TopChainHash(a)
                 next == a.blockChain[height + 1].block
             IN NetworkSend(a, [type |-> "Next in Sequence Response", chainHash |-> message.chainHash,
                                blockHash |-> IF isTop THEN IsTopOfChain ELSE next.hash,
                                timestamp |-> IF isTop THEN TopTimestamp(a) ELSE next.timestamp])

\* Algorithm 14.  4.1: once per responder.  The dictionary is a set of records here.
ReceiveResponseNextInSequence(a, from, message) ==
    IF Active(a, "phase two") /\ message.chainHash = TopChainHash(a) /\ from \notin a.responders
    THEN LET dictionary == a.reconcileResponseDictionary
             same == {r \in dictionary : r.blockHash = message.blockHash}
             counted == IF same = {}
                        THEN {[blockHash |-> message.blockHash, count |-> 1, timestamp |-> message.timestamp]}
                        ELSE {[r EXCEPT !.count = @ + 1] : r \in same}
         IN [a EXCEPT !.reconcileResponseDictionary = (dictionary \ same) \cup counted,
                      !.responders = @ \cup {from}]
    ELSE a

\* Algorithm 15.  A majority is the most responses.  A tie: the oldest timestamp, and then the lowest hash.
ReconcilePhase2TimerExpiration(a) ==
    LET dictionary == a.reconcileResponseDictionary
        most == {r \in dictionary : \A other \in dictionary : other.count <= r.count}
        tied == IF Phase2TieTakesBlock /\ Cardinality(most) > 1
                THEN {r \in most : r.blockHash # IsTopOfChain} ELSE most
        majorityResponse == CHOOSE r \in tied : \A other \in tied :
                                \/ r.timestamp < other.timestamp
                                \/ r.timestamp = other.timestamp /\ r.blockHash <= other.blockHash
    IN CASE dictionary = {} -> Trigger(a, "Reconcile Finalize")
         [] dictionary # {} ->
                IF majorityResponse.blockHash = IsTopOfChain THEN Trigger(a, "Reconcile Finalize")
                ELSE Trigger([a EXCEPT !.majorityResponseBlockHash = majorityResponse.blockHash],
                             "Reconcile Phase 3")

\* Algorithm 16.  Printed: it ends after a block from the stack, and the reconcile never does.  3.5.3, phase 3, step 4
\* goes on with phase 2.  3.1: what is held already is not asked for.
ReconcilePhase3(a) ==
    LET wanted == a.majorityResponseBlockHash
        places == {i \in DOMAIN a.reconcileStack : a.reconcileStack[i].hash = wanted}
        place == CHOOSE i \in places : \A j \in places : j <= i
        taken == Commit([a EXCEPT !.reconcileStack = Without(@, place)], a.reconcileStack[place])
        over == [a EXCEPT !.majorityResponseBlockHash = NoHash]
    IN CASE places # {} ->
                IF 16 \in AsPrinted THEN taken
                ELSE Trigger([taken EXCEPT !.majorityResponseBlockHash = NoHash], "Reconcile Phase 2")
         [] places = {} /\ Holds(a, wanted) -> Trigger(over, "Reconcile Finalize")
         [] places = {} /\ ~Holds(a, wanted) ->
                NetworkSend(Start(a, "phase three"), [type |-> "Request for Block", blockHash |-> wanted])

\* Algorithm 17.
ReceiveRequestBlockForHash(a, from, message) ==
    IF a.reconcileInProgress \/ ~InChain(a, message.blockHash) THEN a
    ELSE NetworkSend(a, [type |-> "Block Response",
                         block |-> CHOOSE b \in Range(Blocks(a.blockChain)) : b.hash = message.blockHash])

\* Algorithm 18.  To pause the timer and to resume it within a handler changes nothing.
ReceiveResponseBlockForHash(a, from, message) ==
    IF Active(a, "phase three") /\ message.block.hash = a.majorityResponseBlockHash
    THEN Trigger([Commit(Stop(a, "phase three"), message.block) EXCEPT !.majorityResponseBlockHash = NoHash],
                 "Reconcile Phase 2")
    ELSE a

\* Algorithm 19.
ReconcilePhase3TimerExpiration(a) ==
    Trigger([a EXCEPT !.majorityResponseBlockHash = NoHash], "Reconcile Finalize")

\* Algorithm 20.  4.2: with a pause between two commits, so that others can follow; the flag stays set.
RECURSIVE ReconcileFinalize(_)
ReconcileFinalize(a) ==
    IF a.reconcileStack = <<>>
    THEN Trigger([a EXCEPT !.reconcileInProgress = FALSE], "Process Next Deque Block")
    ELSE LET committed == Commit([a EXCEPT !.reconcileStack = Front(@)], Last(a.reconcileStack))
             announced == NetworkSend(committed, CommitBlock(committed))
         IN IF announced.reconcileStack # <<>> /\ Duration(a.id, "finalize gap") > 0
            THEN Start(announced, "finalize gap")
            ELSE ReconcileFinalize(announced)

---------------------------------------------------------------------------
(* 3.6 What triggers which handler                                         *)

Receive(a, from, message) ==
    CASE message.type = "Block Add Request" -> ReceiveRequestAddBlock(a, from, message)
      [] message.type = "Block Add Response" -> ReceiveVoteAddBlock(a, from, message)
      [] message.type = "Commit Block" -> ReceiveCommitBlock(a, from, message)
      [] message.type = "Chain Contain Query" -> ReceiveRequestChainContain(a, from, message)
      [] message.type = "Chain Contain Response" -> ReceivePhase1Response(a, from, message)
      [] message.type = "Chain Hash Successor Query" -> ReceiveRequestNextInSequence(a, from, message)
      [] message.type = "Next in Sequence Response" -> ReceiveResponseNextInSequence(a, from, message)
      [] message.type = "Request for Block" -> ReceiveRequestBlockForHash(a, from, message)
      [] message.type = "Block Response" -> ReceiveResponseBlockForHash(a, from, message)

Expire(a, t) ==
    LET stopped == Stop(a, t) IN
    CASE t = "voting" -> VoteTimerExpiration(stopped)
      [] t = "phase one" -> ReconcilePhase1TimerExpiration(stopped)
      [] t = "phase two" -> ReconcilePhase2TimerExpiration(stopped)
      [] t = "phase three" -> ReconcilePhase3TimerExpiration(stopped)
      [] t = "finalize gap" -> ReconcileFinalize(stopped)

\* The first of the local events that have yet to run.
RunNext(a) ==
    LET event == Head(a.triggered)
        rest == [a EXCEPT !.triggered = Tail(@)]
    IN CASE event = "Process Next Deque Block" -> ProcessNextDequeBlock(rest)
         [] event = "Reconcile Begin" -> ReconcileBegin(rest)
         [] event = "Reconcile Phase 1" -> ReconcilePhase1(rest)
         [] event = "Reconcile Phase 2" -> ReconcilePhase2(rest)
         [] event = "Reconcile Phase 3" -> ReconcilePhase3(rest)
         [] event = "Reconcile Finalize" -> ReconcileFinalize(rest)

\* All of them.
RECURSIVE Run(_)
Run(a) == IF a.triggered = <<>> THEN a ELSE Run(RunNext(a))

---------------------------------------------------------------------------
(* 3 What must hold of an agent at any moment                              *)

Kept(a) == Blocks(a.blockChain) \o a.blocksToBeCommittedDeque \o a.reconcileStack

\* Characteristic 2: when it is idle, all of its completed blocks are committed to its chain.
Committed(a) ==
    Idle(a) => /\ a.blocksToBeCommittedDeque = <<>>
               /\ a.reconcileStack = <<>>
               /\ Range(a.completed) \subseteq Range(Blocks(a.blockChain))

\* Characteristic 3: no more than one copy of a block.
NoCopies(a) == \A i, j \in DOMAIN Kept(a) : i # j => Kept(a)[i].hash # Kept(a)[j].hash

\* Each chain hash is that of the blocks below it.
Linked(a) ==
    \A i \in DOMAIN a.blockChain :
        a.blockChain[i].chainHash =
            H(IF i = 1 THEN InceptionChainHash ELSE a.blockChain[i - 1].chainHash, a.blockChain[i].block.hash)

\* An agent that reconciles comes out of it: some timer of the reconcile runs.
NoHang(a) ==
    a.reconcileInProgress => \E t \in {"phase one", "phase two", "phase three", "finalize gap"} : Active(a, t)
=============================================================================
