# Figure 3.9, Receive Commit Block: a block that succeeds the top of the chain is committed; one that does not is not; and
# whoever reconciles commits nothing from others.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block

# 4 reconciles when the first commit comes. It learns of the block all the same, from those whom it asks.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4: yes

10 s: reconcile 4

    at 10 s
      4           7  Reconcile Begin: begun
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2 3       9  Receive Request Chain Contain from 4: yes -> Chain Contain Response (inception: yes)
      4          10  Receive Phase 1 Response from 1 2 3: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.1
      4           6  Receive Commit Block from 1: reconcile in progress
    at 15 s
      4          11  Reconcile Phase 1 Timer Expiration: contained
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2 3      13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (inception: 1.1)
      4          14  Receive Response Next in Sequence from 1 2 3: new candidate, counted
    at 20 s
      4          15  Reconcile Phase 2 Timer Expiration: block
      4          16  Reconcile Phase 3: asked -> Request for Block (1.1)
      1 2 3      17  Receive Request Block for Hash from 4: sent -> Block Response (1.1)
      4          18  Receive Response Block for Hash from 1 2 3: committed, not in phase 3; chain +1.1
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 2 3      13  Receive Request Next in Sequence from 4: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      4          14  Receive Response Next in Sequence from 1 2 3: new candidate, counted
    at 25 s
      4          15  Reconcile Phase 2 Timer Expiration: top of chain
      4          20  Reconcile Finalize: done
      4           2  Process Next Deque Block: deque empty

27 s: 2 logs

    at 27 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 1.1)
      1 3 4       3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 1 3 4: yes
    at 37 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 1.1)
      2           2  Process Next Deque Block: deque empty
      1 3 4       6  Receive Commit Block from 2: committed; chain +2.1

# It does not hear of the next block, and cannot follow the one on top of that.
40 s: 3 does not reach 4
41 s: 3 logs

    at 41 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on 1.1 2.1), not to 4
      1 2         3  Receive Request Add Block from 3: approve -> Block Add Response (3.1: approve)
      3           4  Receive Vote Add Block from 1 2: yes
    at 51 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on 1.1 2.1), not to 4
      3           2  Process Next Deque Block: deque empty
      1 2         6  Receive Commit Block from 3: committed; chain +3.1

55 s: 3 reaches 4 again
60 s: 2 logs

    at 60 s
      2           1  Build Data Block: full; completes 2.2, deque +2.2
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.2 on 1.1 2.1 3.1)
      1 3         3  Receive Request Add Block from 2: approve -> Block Add Response (2.2: approve)
      4           3  Receive Request Add Block from 2: disapprove -> Block Add Response (2.2: disapprove)
      2           4  Receive Vote Add Block from 1 3: yes
      2           4  Receive Vote Add Block from 4: no
    at 70 s
      2           5  Vote Timer Expiration: approved; deque -2.2, chain +2.2 -> Commit Block (2.2 on 1.1 2.1 3.1)
      2           2  Process Next Deque Block: deque empty
      1 3         6  Receive Commit Block from 2: committed; chain +2.2
      4           6  Receive Commit Block from 2: does not succeed

80 s: end

    chains
      inception 1.1 2.1  (4)
        3.1 2.2  (1 2 3)
