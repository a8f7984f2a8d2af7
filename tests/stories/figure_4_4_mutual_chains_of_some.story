# Figure 4.4, 30 percent loss: some have a mutual chain beyond the one that all have, as 1 and 4 have, and 2 and 5. And a
# block of 3 reaches 5 by way of 2, though 3 and 5 do not hear each other; 1.1 is in chains that have nothing else in
# common beyond the system-wide mutual chain.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

# The system-wide mutual chain.
1 s: 4 logs

    at 1 s
      4           1  Build Data Block: full; completes 4.1, deque +4.1
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.1 on inception)
      1 2 3 5     3  Receive Request Add Block from 4: approve -> Block Add Response (4.1: approve)
      4           4  Receive Vote Add Block from 1 2 3 5: yes
    at 11 s
      4           5  Vote Timer Expiration: approved; deque -4.1, chain +4.1 -> Commit Block (4.1 on inception)
      4           2  Process Next Deque Block: deque empty
      1 2 3 5     6  Receive Commit Block from 4: committed; chain +4.1

# 3 is alone, and commits its own.
20 s: partition 3 | 1 2 4 5
21 s: 1 logs

    at 21 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on 4.1), not to 3
      2 4 5       3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 4 5: yes

22 s: 3 logs

    at 22 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on 4.1), not to 1 2 4 5
    at 31 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on 4.1), not to 3
      1           2  Process Next Deque Block: deque empty
      2 4 5       6  Receive Commit Block from 1: committed; chain +1.1
    at 32 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on 4.1), not to 1 2 4 5
      3           2  Process Next Deque Block: deque empty

# Two pairs, and 3.
40 s: partition 3 | 1 4 | 2 5
41 s: 4 logs

    at 41 s
      4           1  Build Data Block: full; completes 4.2, deque +4.2
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.2 on 4.1 1.1), not to 2 3 5
      1           3  Receive Request Add Block from 4: approve -> Block Add Response (4.2: approve)
      4           4  Receive Vote Add Block from 1: yes

42 s: 2 logs

    at 42 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 4.1 1.1), not to 1 3 4
      5           3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 5: yes
    at 51 s
      4           5  Vote Timer Expiration: approved; deque -4.2, chain +4.2 -> Commit Block (4.2 on 4.1 1.1), not to 2 3 5
      4           2  Process Next Deque Block: deque empty
      1           6  Receive Commit Block from 4: committed; chain +4.2
    at 52 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 4.1 1.1), not to 1 3 4
      2           2  Process Next Deque Block: deque empty
      5           6  Receive Commit Block from 2: committed; chain +2.1

# 2 hears 3 alone, and takes from it what it has; what it has besides does not reach 3. Then 5 takes it all from 2.
60 s: partition 2 3 | 1 4 | 5
61 s: reconcile 2

    at 61 s
      2           7  Reconcile Begin: begun
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1 1.1 2.1), not to 1 4 5
      3           9  Receive Request Chain Contain from 2: no -> Chain Contain Response (4.1 1.1 2.1: no)
      2          10  Receive Phase 1 Response from 3: no
    at 66 s
      2          11  Reconcile Phase 1 Timer Expiration: not contained; chain -2.1, stack +2.1
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1 1.1), not to 1 4 5
      3           9  Receive Request Chain Contain from 2: no -> Chain Contain Response (4.1 1.1: no)
      2          10  Receive Phase 1 Response from 3: no
    at 71 s
      2          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.1, stack +1.1
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1), not to 1 4 5
      3           9  Receive Request Chain Contain from 2: yes -> Chain Contain Response (4.1: yes)
      2          10  Receive Phase 1 Response from 3: yes
    at 76 s
      2          11  Reconcile Phase 1 Timer Expiration: contained
      2          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (4.1), not to 1 4 5
      3          13  Receive Request Next in Sequence from 2: successor -> Next in Sequence Response (4.1: 3.1)
      2          14  Receive Response Next in Sequence from 3: new candidate
    at 81 s
      2          15  Reconcile Phase 2 Timer Expiration: block
      2          16  Reconcile Phase 3: asked -> Request for Block (3.1), not to 1 4 5
      3          17  Receive Request Block for Hash from 2: sent -> Block Response (3.1)
      2          18  Receive Response Block for Hash from 3: committed; chain +3.1
      2          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (4.1 3.1), not to 1 4 5
      3          13  Receive Request Next in Sequence from 2: top of chain -> Next in Sequence Response (4.1 3.1: Is Top Of Chain)
      2          14  Receive Response Next in Sequence from 3: new candidate

82 s: 2 does not reach 3

    at 86 s
      2          15  Reconcile Phase 2 Timer Expiration: top of chain
      2          20  Reconcile Finalize: recommitted, more to come; stack -1.1, chain +1.1 -> Commit Block (1.1 on 4.1 3.1), not to 1 3 4 5
      2          20  Reconcile Finalize: done; stack -2.1, chain +2.1 -> Commit Block (2.1 on 4.1 3.1 1.1), not to 1 3 4 5
      2           2  Process Next Deque Block: deque empty

120 s: partition 2 5 | 1 4 | 3
121 s: reconcile 5

    at 121 s
      5           7  Reconcile Begin: begun
      5           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1 1.1 2.1), not to 1 3 4
      2           9  Receive Request Chain Contain from 5: no -> Chain Contain Response (4.1 1.1 2.1: no)
      5          10  Receive Phase 1 Response from 2: no
    at 126 s
      5          11  Reconcile Phase 1 Timer Expiration: not contained; chain -2.1, stack +2.1
      5           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1 1.1), not to 1 3 4
      2           9  Receive Request Chain Contain from 5: no -> Chain Contain Response (4.1 1.1: no)
      5          10  Receive Phase 1 Response from 2: no
    at 131 s
      5          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.1, stack +1.1
      5           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1), not to 1 3 4
      2           9  Receive Request Chain Contain from 5: yes -> Chain Contain Response (4.1: yes)
      5          10  Receive Phase 1 Response from 2: yes
    at 136 s
      5          11  Reconcile Phase 1 Timer Expiration: contained
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (4.1), not to 1 3 4
      2          13  Receive Request Next in Sequence from 5: successor -> Next in Sequence Response (4.1: 3.1)
      5          14  Receive Response Next in Sequence from 2: new candidate
    at 141 s
      5          15  Reconcile Phase 2 Timer Expiration: block
      5          16  Reconcile Phase 3: asked -> Request for Block (3.1), not to 1 3 4
      2          17  Receive Request Block for Hash from 5: sent -> Block Response (3.1)
      5          18  Receive Response Block for Hash from 2: committed; chain +3.1
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (4.1 3.1), not to 1 3 4
      2          13  Receive Request Next in Sequence from 5: successor -> Next in Sequence Response (4.1 3.1: 1.1)
      5          14  Receive Response Next in Sequence from 2: new candidate
    at 146 s
      5          15  Reconcile Phase 2 Timer Expiration: block
      5          16  Reconcile Phase 3: from the stack; stack -1.1, chain +1.1
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (4.1 3.1 1.1), not to 1 3 4
      2          13  Receive Request Next in Sequence from 5: successor -> Next in Sequence Response (4.1 3.1 1.1: 2.1)
      5          14  Receive Response Next in Sequence from 2: new candidate
    at 151 s
      5          15  Reconcile Phase 2 Timer Expiration: block
      5          16  Reconcile Phase 3: from the stack; stack -2.1, chain +2.1
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (4.1 3.1 1.1 2.1), not to 1 3 4
      2          13  Receive Request Next in Sequence from 5: top of chain -> Next in Sequence Response (4.1 3.1 1.1 2.1: Is Top Of Chain)
      5          14  Receive Response Next in Sequence from 2: new candidate
    at 156 s
      5          15  Reconcile Phase 2 Timer Expiration: top of chain
      5          20  Reconcile Finalize: done
      5           2  Process Next Deque Block: deque empty

200 s: end

    chains
      inception 4.1
        1.1 4.2  (1 4)
        3.1  (3)
          1.1 2.1  (2 5)
