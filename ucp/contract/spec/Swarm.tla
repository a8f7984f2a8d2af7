------------------------------- MODULE Swarm -------------------------------
(***************************************************************************)
(* All that a swarm can come to.  A step is an instant: timers of some     *)
(* agents end and some agents complete a block, none of them having heard  *)
(* yet of what the others do; then everybody hears what was sent, then     *)
(* what was answered to that, and so on until nobody says anything more.   *)
(* docs/explanation/proof.md says the same of `ucp-harness prove`.                     *)
(***************************************************************************)
EXTENDS Integers, Sequences, FiniteSets

CONSTANTS
    Agents,      \* so many
    MostBlocks,  \* are completed in all
    Lossy,       \* each agent for itself may lose any message
    Crossing,    \* agents act at once, and hear of each other after that; otherwise one by one
    Timed,       \* timers end when they are over; otherwise whenever they run
    VoteTimeout, Phase1Timeout, Phase2Timeout, Phase3Timeout, FinalizeGap,   \* of agent 1, in some common unit
    VoteStagger, Phase1Stagger, Phase2Stagger, Phase3Stagger, FinalizeStagger,   \* longer by it from agent to agent
    VoteNamesChain, ChangedBeforeTally, Phase1TiePops, Phase2TieTakesBlock, AsPrinted

VARIABLE swarm

\* Of an active timer there is one more than what is left of it.
Counted(units) == IF Timed THEN units + 1 ELSE 1
Lasts(id, t) ==
    CASE t = "voting" -> VoteTimeout + (id - 1) * VoteStagger
      [] t = "phase one" -> Phase1Timeout + (id - 1) * Phase1Stagger
      [] t = "phase two" -> Phase2Timeout + (id - 1) * Phase2Stagger
      [] t = "phase three" -> Phase3Timeout + (id - 1) * Phase3Stagger
      [] t = "finalize gap" -> FinalizeGap + (id - 1) * FinalizeStagger
DurationOf(id, t) == IF t = "finalize gap" /\ Lasts(id, t) = 0 THEN 0 ELSE Counted(Lasts(id, t))

\* Blocks are 1, 2, ... in the order in which they are completed; of chain hash 31 the blocks are 3 and 1.
INSTANCE UCP WITH H <- LAMBDA below, hash : 10 * below + hash, InceptionChainHash <- 0,
                  Duration <- DurationOf, SizeMaxEvent <- 1, SizeMaxBlock <- 1

Everybody == 1 .. Agents
Init == swarm = [id \in Everybody |-> Fresh(id)]

---------------------------------------------------------------------------
(* What is said and heard.  An utterance is [from, message, n].            *)

\* What an agent says of its own in one go is in order; answers overtake each other, and n only tells equal ones apart.
InOrder(a) == {[from |-> a.id, message |-> a.sent[i], n |-> i] : i \in DOMAIN a.sent}
Unordered(a) ==
    {[from |-> a.id, message |-> a.sent[i], n |-> Cardinality({j \in 1 .. i : a.sent[j] = a.sent[i]})]
        : i \in DOMAIN a.sent}
Silent(a) == [a EXCEPT !.sent = <<>>]

\* What an agent can hear next, and what it can hear then.
Next1(hearing, ordered) ==
    LET mail == hearing.mail
        earlier(u) == {v \in mail : ordered /\ v.from = u.from /\ v.n < u.n}
    IN {[agent |-> Run(Receive(hearing.agent, u.from, u.message)), mail |-> mail \ ({u} \cup earlier(u))]
        : u \in {v \in mail : Lossy \/ earlier(v) = {}}}

RECURSIVE AllHeard(_, _)
AllHeard(hearings, ordered) ==
    IF hearings = {} THEN {}
    ELSE hearings \cup AllHeard(UNION {Next1(h, ordered) : h \in hearings}, ordered)

\* All that can become of an agent that gets this mail: as it is then, and what it answers.
Outcomes(a, mail, ordered) ==
    {[agent |-> Silent(h.agent), says |-> Unordered(h.agent)]
        : h \in {h \in AllHeard({[agent |-> a, mail |-> mail]}, ordered) : Lossy \/ h.mail = {}}}

RECURSIVE Choices(_, _)
Choices(sets, n) == IF n = 0 THEN {<<>>} ELSE {Append(c, x) : c \in Choices(sets, n - 1), x \in sets[n]}

\* All that can become of the agents when this is on the air.
RECURSIVE Settled(_, _, _)
Settled(agents, air, ordered) ==
    IF air = {} THEN {agents}
    ELSE LET outcomes == [id \in Everybody |-> Outcomes(agents[id], {u \in air : u.from # id}, ordered)]
         IN UNION {Settled([id \in Everybody |-> c[id].agent], UNION {c[id].says : id \in Everybody}, FALSE)
                       : c \in Choices(outcomes, Agents)}

---------------------------------------------------------------------------
(* Time passes in whole units.  All timers may end when they are over and  *)
(* not later, so what can be reached is what can be at any times           *)
(* whatsoever, if all durations are whole (Henzinger, Manna and Pnueli).   *)

Left(agents) == {agents[id].timer[t] - 1 : id \in Everybody, t \in Timers} \ {-1}
Pauses(agents) ==
    IF ~Timed \/ Left(agents) = {} THEN {0}
    ELSE 0 .. (CHOOSE least \in Left(agents) : \A other \in Left(agents) : least <= other)
After(agents, pause) ==
    IF pause = 0 THEN agents
    ELSE [id \in Everybody |->
             [agents[id] EXCEPT !.timer = [t \in Timers |-> IF @[t] = 0 THEN 0 ELSE @[t] - pause]]]
Over(a) == {t \in Timers : IF Timed THEN a.timer[t] = 1 ELSE a.timer[t] > 0}

---------------------------------------------------------------------------
(* An instant                                                              *)

RECURSIVE CompletedBy(_)
CompletedBy(n) == IF n = 0 THEN 0 ELSE Len(swarm[n].completed) + CompletedBy(n - 1)
Completed == CompletedBy(Agents)

\* Whose timers end, of each agent one at most.
Endings(agents) ==
    UNION {{ends \in [who -> Timers] : \A id \in who : ends[id] \in Over(agents[id])}
               : who \in SUBSET {id \in Everybody : Over(agents[id]) # {}}}

\* Who completes the next blocks, in the order of their timestamps.
Makers(others) ==
    {makers \in UNION {[1 .. count -> others] : count \in 0 .. (MostBlocks - Completed)} :
        \A i, j \in DOMAIN makers : i # j => makers[i] # makers[j]}

Complete(a, number) ==
    BuildDataBlock(a, [size |-> 1, block |-> [hash |-> number, timestamp |-> number, agentID |-> a.id]])

Instant ==
    \E pause \in Pauses(swarm) :
        LET now == After(swarm, pause) IN
        \E ends \in Endings(now) : \E makers \in Makers(Everybody \ DOMAIN ends) :
            LET order(id) == CHOOSE i \in DOMAIN makers : makers[i] = id
                acted == [id \in Everybody |->
                    IF id \in DOMAIN ends THEN Run(Expire(now[id], ends[id]))
                    ELSE IF id \in Range(makers) THEN Run(Complete(now[id], Completed + order(id)))
                    ELSE now[id]]
                acting == Cardinality(DOMAIN ends) + Len(makers)
            IN /\ acting = 1 \/ (Crossing /\ acting > 1)
               /\ swarm' \in Settled([id \in Everybody |-> Silent(acted[id])],
                                     UNION {InOrder(acted[id]) : id \in Everybody}, TRUE)

Spec == Init /\ [][Instant]_swarm

---------------------------------------------------------------------------
(* 3 The characteristics that can be seen at one agent, and no hang        *)

Characteristic2 == \A id \in Everybody : Committed(swarm[id])
Characteristic3 == \A id \in Everybody : NoCopies(swarm[id])
Characteristic4 ==
    \A id \in Everybody : Linked(swarm[id]) /\ \A block \in Range(Kept(swarm[id])) :
        block.agentID \in Everybody /\ block \in Range(swarm[block.agentID].completed)
NobodyHangs == \A id \in Everybody : NoHang(swarm[id])
=============================================================================
