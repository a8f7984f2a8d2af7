# Figure 3.8, Vote Timer Expiration: the block is committed if more approve than not and the chain is what it was; if the
# chain has changed the vote is held again; if not more approve, the agent reconciles.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

# Approved. And 2, which has proposed its block on the same chain, is approved, too, but for a chain that is no more:
# it votes again.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3         3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3: yes

3 s: 2 logs

    at 3 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception)
      1 3         3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 1 3: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.1
    at 13 s
      2           5  Vote Timer Expiration: chain changed
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 1.1)
      1 3         3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 1 3: yes
    at 23 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 1.1)
      2           2  Process Next Deque Block: deque empty
      1 3         6  Receive Commit Block from 2: committed; chain +2.1

# Not approved: 1 does not have the block that 3 has committed by itself, and the vote of 2 is lost. A tie is no majority.
40 s: partition 3 | 1 2
41 s: 3 logs

    at 41 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on 1.1 2.1), not to 1 2
    at 51 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on 1.1 2.1), not to 1 2
      3           2  Process Next Deque Block: deque empty

55 s: heal
57 s: 2 does not reach 3
60 s: 3 logs

    at 60 s
      3           1  Build Data Block: full; completes 3.2, deque +3.2
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.2 on 1.1 2.1 3.1)
      1           3  Receive Request Add Block from 3: disapprove -> Block Add Response (3.2: disapprove)
      2           3  Receive Request Add Block from 3: disapprove -> Block Add Response (3.2: disapprove), not to 3
      3           4  Receive Vote Add Block from 1: no

62 s: 2 reaches 3 again

    at 70 s
      3           5  Vote Timer Expiration: not approved
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 2.1 3.1)
      1 2         9  Receive Request Chain Contain from 3: no -> Chain Contain Response (1.1 2.1 3.1: no)
      3          10  Receive Phase 1 Response from 1 2: no
    at 75 s
      3          11  Reconcile Phase 1 Timer Expiration: not contained; chain -3.1, stack +3.1
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 2.1)
      1 2         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (1.1 2.1: yes)
      3          10  Receive Phase 1 Response from 1 2: yes
    at 80 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 2.1)
      1 2        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (1.1 2.1: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 85 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done; stack -3.1, chain +3.1 -> Commit Block (3.1 on 1.1 2.1)
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.2 on 1.1 2.1 3.1)
      1 2         6  Receive Commit Block from 3: committed; chain +3.1
      1 2         3  Receive Request Add Block from 3: approve -> Block Add Response (3.2: approve)
      3           4  Receive Vote Add Block from 1 2: yes
    at 95 s
      3           5  Vote Timer Expiration: approved; deque -3.2, chain +3.2 -> Commit Block (3.2 on 1.1 2.1 3.1)
      3           2  Process Next Deque Block: deque empty
      1 2         6  Receive Commit Block from 3: committed; chain +3.2

# A vote that ends during a reconcile decides nothing, and is held again after it.
120 s: 1 logs

    at 120 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1 2.1 3.1 3.2)
      2 3         3  Receive Request Add Block from 1: approve -> Block Add Response (1.2: approve)
      1           4  Receive Vote Add Block from 2 3: yes

123 s: reconcile 1

    at 123 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 2.1 3.1 3.2)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (1.1 2.1 3.1 3.2: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 128 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 2.1 3.1 3.2)
      2 3        13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (1.1 2.1 3.1 3.2: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3: new candidate, counted
    at 130 s
      1           5  Vote Timer Expiration: reconcile in progress
    at 133 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1 2.1 3.1 3.2)
      2 3         3  Receive Request Add Block from 1: approve -> Block Add Response (1.2: approve)
      1           4  Receive Vote Add Block from 2 3: yes
    at 143 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1 2.1 3.1 3.2)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.2

160 s: end

    chains
      inception 1.1 2.1 3.1 3.2 1.2  (1 2 3)
