# Figure 3.19, Reconcile Phase 3: the block is taken from the stack if it is there, and asked for if it is not.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block

# 1 has a block that 2 commits on top of another one: in the chain of 1 they are the other way round.

1 s: partition 1 | 2 3 4
2 s: 1 logs

    at 2 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception), not to 2 3 4

3 s: 2 logs

    at 3 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1
      3 4         3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 3 4: yes
    at 12 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 2 3 4
      1           2  Process Next Deque Block: deque empty
    at 13 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1
      2           2  Process Next Deque Block: deque empty
      3 4         6  Receive Commit Block from 2: committed; chain +2.1

20 s: heal
25 s: reconcile 1

    at 25 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      2 3 4       9  Receive Request Chain Contain from 1: no -> Chain Contain Response (1.1: no)
      1          10  Receive Phase 1 Response from 2 3 4: no
    at 30 s
      1          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.1, stack +1.1
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3 4       9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3 4: yes
    at 35 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2 3 4      13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 2.1)
      1          14  Receive Response Next in Sequence from 2 3 4: new candidate, counted
    at 40 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      2 3 4      17  Receive Request Block for Hash from 1: sent -> Block Response (2.1)
      1          18  Receive Response Block for Hash from 2 3 4: committed, not in phase 3; chain +2.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      2 3 4      13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3 4: new candidate, counted
    at 45 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done; stack -1.1, chain +1.1 -> Commit Block (1.1 on 2.1)
      1           2  Process Next Deque Block: deque empty
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.1

70 s: end

    chains
      inception 2.1 1.1  (1 2 3 4)
