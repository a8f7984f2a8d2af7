# Figure 3.12, Receive Request Chain Contain: yes if the chain contains the chain hash, and be it far below its top; no if
# it does not; and nothing during a reconcile of one's own.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.1

# 2 commits a block, which of the others only 1 follows.
20 s: 2 does not reach 3 4
21 s: 2 logs

    at 21 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 1.1), not to 3 4
      1           3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 1: yes
    at 31 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 1.1), not to 3 4
      2           2  Process Next Deque Block: deque empty
      1           6  Receive Commit Block from 2: committed; chain +2.1

35 s: 2 reaches 3 4 again

# 3 asks about a chain that 1 and 2 have below their top. 2 asks about its whole chain, while 3 reconciles.
40 s: reconcile 3

    at 40 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      1 2 4       9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (1.1: yes)
      3          10  Receive Phase 1 Response from 1 2 4: yes

41 s: reconcile 2

    at 41 s
      2           7  Reconcile Begin: begun
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 2.1)
      1           9  Receive Request Chain Contain from 2: yes -> Chain Contain Response (1.1 2.1: yes)
      3           9  Receive Request Chain Contain from 2: reconcile in progress
      4           9  Receive Request Chain Contain from 2: no -> Chain Contain Response (1.1 2.1: no)
      2          10  Receive Phase 1 Response from 1: yes
      2          10  Receive Phase 1 Response from 4: no

44 s: 2 does not reach 4

    at 45 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1          13  Receive Request Next in Sequence from 3: successor -> Next in Sequence Response (1.1: 2.1)
      2          13  Receive Request Next in Sequence from 3: reconcile in progress
      4          13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 1: new candidate
      3          14  Receive Response Next in Sequence from 4: new candidate
    at 46 s
      2          11  Reconcile Phase 1 Timer Expiration: contained
      2          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 2.1), not to 4
      1          13  Receive Request Next in Sequence from 2: top of chain -> Next in Sequence Response (1.1 2.1: Is Top Of Chain)
      3          13  Receive Request Next in Sequence from 2: reconcile in progress
      2          14  Receive Response Next in Sequence from 1: new candidate
    at 50 s
      3          15  Reconcile Phase 2 Timer Expiration: tie: top of chain
      3          20  Reconcile Finalize: done
      3           2  Process Next Deque Block: deque empty
    at 51 s
      2          15  Reconcile Phase 2 Timer Expiration: top of chain
      2          20  Reconcile Finalize: done
      2           2  Process Next Deque Block: deque empty

80 s: end

    chains
      inception 1.1  (3 4)
        2.1  (1 2)
