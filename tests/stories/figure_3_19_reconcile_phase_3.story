# Figure 3.19, Reconcile Phase 3: the block is taken from the stack if it is there, and asked for if it is not.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

# 1 and 2 have 1.1, the others 3.1.
1 s: partition 1 2 | 3 4 5
2 s: 1 logs

    at 2 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception), not to 3 4 5
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2: yes

3 s: 3 logs

    at 3 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on inception), not to 1 2
      4 5         3  Receive Request Add Block from 3: approve -> Block Add Response (3.1: approve)
      3           4  Receive Vote Add Block from 4 5: yes
    at 12 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 3 4 5
      1           2  Process Next Deque Block: deque empty
      2           6  Receive Commit Block from 1: committed; chain +1.1
    at 13 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on inception), not to 1 2
      3           2  Process Next Deque Block: deque empty
      4 5         6  Receive Commit Block from 3: committed; chain +3.1

20 s: heal

# 2 reconciles, and puts 1.1 on top of 3.1, for all but 1, which does not hear of that.
21 s: 2 does not reach 1
25 s: reconcile 2

    at 25 s
      2           7  Reconcile Begin: begun
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1), not to 1
      3 4 5       9  Receive Request Chain Contain from 2: no -> Chain Contain Response (1.1: no)
      2          10  Receive Phase 1 Response from 3 4 5: no
    at 30 s
      2          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.1, stack +1.1
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (inception), not to 1
      3 4 5       9  Receive Request Chain Contain from 2: yes -> Chain Contain Response (inception: yes)
      2          10  Receive Phase 1 Response from 3 4 5: yes
    at 35 s
      2          11  Reconcile Phase 1 Timer Expiration: contained
      2          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception), not to 1
      3 4 5      13  Receive Request Next in Sequence from 2: successor -> Next in Sequence Response (inception: 3.1)
      2          14  Receive Response Next in Sequence from 3 4 5: new candidate, counted
    at 40 s
      2          15  Reconcile Phase 2 Timer Expiration: block
      2          16  Reconcile Phase 3: asked -> Request for Block (3.1), not to 1
      3 4 5      17  Receive Request Block for Hash from 2: sent -> Block Response (3.1)
      2          18  Receive Response Block for Hash from 3 4 5: committed, not in phase 3; chain +3.1
      2          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (3.1), not to 1
      3 4 5      13  Receive Request Next in Sequence from 2: top of chain -> Next in Sequence Response (3.1: Is Top Of Chain)
      2          14  Receive Response Next in Sequence from 3 4 5: new candidate, counted
    at 45 s
      2          15  Reconcile Phase 2 Timer Expiration: top of chain
      2          20  Reconcile Finalize: done; stack -1.1, chain +1.1 -> Commit Block (1.1 on 3.1), not to 1
      2           2  Process Next Deque Block: deque empty
      3 4 5       6  Receive Commit Block from 2: committed; chain +1.1

60 s: 2 reaches 1 again

# 1 has 1.1 on its stack when it is told that it follows 3.1, for which it had to ask.
65 s: reconcile 1

    at 65 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      2 3 4 5     9  Receive Request Chain Contain from 1: no -> Chain Contain Response (1.1: no)
      1          10  Receive Phase 1 Response from 2 3 4 5: no
    at 70 s
      1          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.1, stack +1.1
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3 4 5     9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3 4 5: yes
    at 75 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2 3 4 5    13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 3.1)
      1          14  Receive Response Next in Sequence from 2 3 4 5: new candidate, counted
    at 80 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (3.1)
      2 3 4 5    17  Receive Request Block for Hash from 1: sent -> Block Response (3.1)
      1          18  Receive Response Block for Hash from 2 3 4 5: committed, not in phase 3; chain +3.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (3.1)
      2 3 4 5    13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (3.1: 1.1)
      1          14  Receive Response Next in Sequence from 2 3 4 5: new candidate, counted
    at 85 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: from the stack; stack -1.1, chain +1.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (3.1 1.1)
      2 3 4 5    13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (3.1 1.1: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3 4 5: new candidate, counted
    at 90 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

110 s: end

    chains
      inception 3.1 1.1  (1 2 3 4 5)
