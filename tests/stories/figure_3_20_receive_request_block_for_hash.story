# Figure 3.20, Receive Request Block for Hash: whoever has the block in its chain sends it, whoever does not says nothing,
# and neither does whoever reconciles.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

# 2, 3 and 5 commit a block, 4 does not hear of it, and neither does 1. When 1 asks for it, 3 reconciles.
1 s: partition 1 | 4 | 2 3 5
2 s: 2 logs

    at 2 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1 4
      3 5         3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 3 5: yes
    at 12 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1 4
      2           2  Process Next Deque Block: deque empty
      3 5         6  Receive Commit Block from 2: committed; chain +2.1

14 s: heal
20 s: reconcile 1

    at 20 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3 4 5     9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3 4 5: yes
    at 25 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2 3 5      13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 2.1)
      4          13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (inception: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3 5: new candidate, counted
      1          14  Receive Response Next in Sequence from 4: new candidate

28 s: reconcile 3

    at 28 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (2.1)
      1           9  Receive Request Chain Contain from 3: reconcile in progress
      2 5         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (2.1: yes)
      4           9  Receive Request Chain Contain from 3: no -> Chain Contain Response (2.1: no)
      3          10  Receive Phase 1 Response from 2 5: yes
      3          10  Receive Phase 1 Response from 4: no
    at 30 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      2 5        17  Receive Request Block for Hash from 1: sent -> Block Response (2.1)
      3          17  Receive Request Block for Hash from 1: reconcile in progress
      4          17  Receive Request Block for Hash from 1: not held
      1          18  Receive Response Block for Hash from 2 5: committed, not in phase 3; chain +2.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      2 5        13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      3          13  Receive Request Next in Sequence from 1: reconcile in progress
      4          13  Receive Request Next in Sequence from 1: diverged
      4           7  Reconcile Begin: begun
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1          14  Receive Response Next in Sequence from 2 5: new candidate, counted
      1 3         9  Receive Request Chain Contain from 4: reconcile in progress
      2 5         9  Receive Request Chain Contain from 4: yes -> Chain Contain Response (inception: yes)
      4          10  Receive Phase 1 Response from 2 5: yes

32 s: 4 does not reach 1

    at 33 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      1 4        13  Receive Request Next in Sequence from 3: reconcile in progress
      2 5        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 2 5: new candidate, counted
    at 35 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty
      4          11  Reconcile Phase 1 Timer Expiration: contained
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception), not to 1
      2 5        13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (inception: 2.1)
      3          13  Receive Request Next in Sequence from 4: reconcile in progress
      4          14  Receive Response Next in Sequence from 2 5: new candidate, counted
    at 38 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done
      3           2  Process Next Deque Block: deque empty
    at 40 s
      4          15  Reconcile Phase 2 Timer Expiration: block
      4          16  Reconcile Phase 3: asked -> Request for Block (2.1), not to 1
      2 3 5      17  Receive Request Block for Hash from 4: sent -> Block Response (2.1)
      4          18  Receive Response Block for Hash from 2 3 5: committed, not in phase 3; chain +2.1
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1), not to 1
      2 3 5      13  Receive Request Next in Sequence from 4: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      4          14  Receive Response Next in Sequence from 2 3 5: new candidate, counted
    at 45 s
      4          15  Reconcile Phase 2 Timer Expiration: top of chain
      4          20  Reconcile Finalize: done
      4           2  Process Next Deque Block: deque empty

70 s: end

    chains
      inception 2.1  (1 2 3 4 5)
