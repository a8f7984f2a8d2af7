# Figure 3.10, Reconcile Begin: it is triggered by a lost vote, or by the question of an agent whose chain is not this
# agent's own (Figure 3.16). An agent that reconciles already goes on with that.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

1 s: partition 3 | 1 2
2 s: 3 logs

    at 2 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on inception), not to 1 2
    at 12 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on inception), not to 1 2
      3           2  Process Next Deque Block: deque empty

14 s: heal

# A lost vote.
20 s: 3 logs

    at 20 s
      3           1  Build Data Block: full; completes 3.2, deque +3.2
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.2 on 3.1)
      1 2         3  Receive Request Add Block from 3: disapprove -> Block Add Response (3.2: disapprove)
      3           4  Receive Vote Add Block from 1 2: no
    at 30 s
      3           5  Vote Timer Expiration: not approved
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (3.1)
      1 2         9  Receive Request Chain Contain from 3: no -> Chain Contain Response (3.1: no)
      3          10  Receive Phase 1 Response from 1 2: no

# The operator asks for what is under way already.
32 s: reconcile 3

    at 32 s
      3           7  Reconcile Begin: already in progress
    at 35 s
      3          11  Reconcile Phase 1 Timer Expiration: not contained; chain -3.1, stack +3.1
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (inception: yes)
      3          10  Receive Phase 1 Response from 1 2: yes
    at 40 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (inception: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 45 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done; stack -3.1, chain +3.1 -> Commit Block (3.1 on inception)
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.2 on 3.1)
      1 2         6  Receive Commit Block from 3: committed; chain +3.1
      1 2         3  Receive Request Add Block from 3: approve -> Block Add Response (3.2: approve)
      3           4  Receive Vote Add Block from 1 2: yes
    at 55 s
      3           5  Vote Timer Expiration: approved; deque -3.2, chain +3.2 -> Commit Block (3.2 on 3.1)
      3           2  Process Next Deque Block: deque empty
      1 2         6  Receive Commit Block from 3: committed; chain +3.2

70 s: end

    chains
      inception 3.1 3.2  (1 2 3)
