# Figure 3.18, Reconcile Phase 2 Timer Expiration: the plurality decides, and the oldest candidate where there is a tie.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

# A tie: 2 names its block, 3 says that the chain ends here. What it names is older, the inception block, and so the
# search ends: 1 does not get the block.

1 s: partition 1 | 2 | 3
2 s: 2 logs

    at 2 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1 3
    at 12 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1 3
      2           2  Process Next Deque Block: deque empty

14 s: heal
20 s: reconcile 1

    at 20 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 25 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2          13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 2.1)
      3          13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (inception: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2: new candidate
      1          14  Receive Response Next in Sequence from 3: new candidate
    at 30 s
      1          15  Reconcile Phase 2 Timer Expiration: tie: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

# A tie of two blocks: the older one is asked for.
40 s: partition 1 | 2 | 3
41 s: 3 logs

    at 41 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on inception), not to 1 2
    at 51 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on inception), not to 1 2
      3           2  Process Next Deque Block: deque empty

55 s: heal
60 s: reconcile 1

    at 60 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 65 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2          13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 2.1)
      3          13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 3.1)
      1          14  Receive Response Next in Sequence from 2: new candidate
      1          14  Receive Response Next in Sequence from 3: new candidate
    at 70 s
      1          15  Reconcile Phase 2 Timer Expiration: tie: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      2          17  Receive Request Block for Hash from 1: sent -> Block Response (2.1)
      3          17  Receive Request Block for Hash from 1: not held
      1          18  Receive Response Block for Hash from 2: committed; chain +2.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      2          13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      3          13  Receive Request Next in Sequence from 1: diverged
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (3.1)
      1          14  Receive Response Next in Sequence from 2: new candidate
      1           9  Receive Request Chain Contain from 3: reconcile in progress
      2           9  Receive Request Chain Contain from 3: no -> Chain Contain Response (3.1: no)
      3          10  Receive Phase 1 Response from 2: no
    at 75 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty
      3          11  Reconcile Phase 1 Timer Expiration: not contained; chain -3.1, stack +3.1
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (inception: yes)
      3          10  Receive Phase 1 Response from 1 2: yes
    at 80 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2        13  Receive Request Next in Sequence from 3: successor -> Next in Sequence Response (inception: 2.1)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 85 s
      3          15  Reconcile Phase 2 Timer Expiration: block
      3          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      1 2        17  Receive Request Block for Hash from 3: sent -> Block Response (2.1)
      3          18  Receive Response Block for Hash from 1 2: committed, not in phase 3; chain +2.1
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      1 2        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 90 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done; stack -3.1, chain +3.1 -> Commit Block (3.1 on 2.1)
      3           2  Process Next Deque Block: deque empty
      1 2         6  Receive Commit Block from 3: committed; chain +3.1

# No response at all: the others reconcile, or are out of reach, when phase 2 asks.
120 s: reconcile 1

    at 120 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (2.1 3.1)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (2.1 3.1: yes)
      1          10  Receive Phase 1 Response from 2 3: yes

123 s: partition 1 | 2 | 3

    at 125 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1 3.1), not to 2 3
    at 130 s
      1          15  Reconcile Phase 2 Timer Expiration: no response
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

140 s: heal
150 s: end

    chains
      inception 2.1 3.1  (1 2 3)
