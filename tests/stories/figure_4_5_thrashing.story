# Figure 4.5, 50 percent loss: once the chains have parted practically every proposal is disapproved, and too much of a
# reconcile is lost for it to get anywhere: each agent ends where it was, and commits its own blocks on top.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

# Early a block gets through.
1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4 5     3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4 5: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3 4 5     6  Receive Commit Block from 1: committed; chain +1.1

# Then everybody commits a block by itself.
20 s: partition 1 | 2 | 3 | 4 | 5
21 s: 1 logs

    at 21 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1), not to 2 3 4 5

22 s: 2 logs

    at 22 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 1.1), not to 1 3 4 5

23 s: 3 logs

    at 23 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on 1.1), not to 1 2 4 5

24 s: 4 logs

    at 24 s
      4           1  Build Data Block: full; completes 4.1, deque +4.1
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.1 on 1.1), not to 1 2 3 5

25 s: 5 logs

    at 25 s
      5           1  Build Data Block: full; completes 5.1, deque +5.1
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on 1.1), not to 1 2 3 4
    at 31 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1), not to 2 3 4 5
      1           2  Process Next Deque Block: deque empty
    at 32 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 1.1), not to 1 3 4 5
      2           2  Process Next Deque Block: deque empty
    at 33 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on 1.1), not to 1 2 4 5
      3           2  Process Next Deque Block: deque empty
    at 34 s
      4           5  Vote Timer Expiration: approved; deque -4.1, chain +4.1 -> Commit Block (4.1 on 1.1), not to 1 2 3 5
      4           2  Process Next Deque Block: deque empty
    at 35 s
      5           5  Vote Timer Expiration: approved; deque -5.1, chain +5.1 -> Commit Block (5.1 on 1.1), not to 1 2 3 4
      5           2  Process Next Deque Block: deque empty

40 s: heal

# Everybody disapproves of the next block of 3. It reconciles, and its second question is lost.
45 s: 3 logs

    at 45 s
      3           1  Build Data Block: full; completes 3.2, deque +3.2
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.2 on 1.1 3.1)
      1 2 4 5     3  Receive Request Add Block from 3: disapprove -> Block Add Response (3.2: disapprove)
      3           4  Receive Vote Add Block from 1 2 4 5: no
    at 55 s
      3           5  Vote Timer Expiration: not approved
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 3.1)
      1 2 4 5     9  Receive Request Chain Contain from 3: no -> Chain Contain Response (1.1 3.1: no)
      3          10  Receive Phase 1 Response from 1 2 4 5: no

57 s: 3 does not reach 1 2 4 5

    at 60 s
      3          11  Reconcile Phase 1 Timer Expiration: not contained; chain -3.1, stack +3.1
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1), not to 1 2 4 5
    at 65 s
      3          11  Reconcile Phase 1 Timer Expiration: no response
      3          20  Reconcile Finalize: done; stack -3.1, chain +3.1 -> Commit Block (3.1 on 1.1), not to 1 2 4 5
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.2 on 1.1 3.1), not to 1 2 4 5
    at 75 s
      3           5  Vote Timer Expiration: approved; deque -3.2, chain +3.2 -> Commit Block (3.2 on 1.1 3.1), not to 1 2 4 5
      3           2  Process Next Deque Block: deque empty

80 s: 3 reaches 1 2 4 5 again

# That of 4 fares no better. It hears of the oldest of four different blocks, and the block itself is lost.
85 s: 4 logs

    at 85 s
      4           1  Build Data Block: full; completes 4.2, deque +4.2
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.2 on 1.1 4.1)
      1 2 3 5     3  Receive Request Add Block from 4: disapprove -> Block Add Response (4.2: disapprove)
      4           4  Receive Vote Add Block from 1 2 3 5: no
    at 95 s
      4           5  Vote Timer Expiration: not approved
      4           7  Reconcile Begin: begun
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 4.1)
      1 2 3 5     9  Receive Request Chain Contain from 4: no -> Chain Contain Response (1.1 4.1: no)
      4          10  Receive Phase 1 Response from 1 2 3 5: no
    at 100 s
      4          11  Reconcile Phase 1 Timer Expiration: not contained; chain -4.1, stack +4.1
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      1 2 3 5     9  Receive Request Chain Contain from 4: yes -> Chain Contain Response (1.1: yes)
      4          10  Receive Phase 1 Response from 1 2 3 5: yes
    at 105 s
      4          11  Reconcile Phase 1 Timer Expiration: contained
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1          13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (1.1: 1.2)
      2          13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (1.1: 2.1)
      3          13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (1.1: 3.1)
      5          13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (1.1: 5.1)
      4          14  Receive Response Next in Sequence from 1: new candidate
      4          14  Receive Response Next in Sequence from 2: new candidate
      4          14  Receive Response Next in Sequence from 3: new candidate
      4          14  Receive Response Next in Sequence from 5: new candidate

107 s: 1 does not reach 4

    at 110 s
      4          15  Reconcile Phase 2 Timer Expiration: tie: block
      4          16  Reconcile Phase 3: asked -> Request for Block (1.2)
      1          17  Receive Request Block for Hash from 4: sent -> Block Response (1.2), not to 4
      2 3 5      17  Receive Request Block for Hash from 4: not held
    at 115 s
      4          19  Reconcile Phase 3 Timer Expiration: gave up
      4          20  Reconcile Finalize: done; stack -4.1, chain +4.1 -> Commit Block (4.1 on 1.1)
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.2 on 1.1 4.1)
      1 2 3 5     6  Receive Commit Block from 4: does not succeed
      1           3  Receive Request Add Block from 4: disapprove -> Block Add Response (4.2: disapprove), not to 4
      2 3 5       3  Receive Request Add Block from 4: disapprove -> Block Add Response (4.2: disapprove)
      4           4  Receive Vote Add Block from 2 3 5: no

117 s: 4 does not reach 1 2 3 5

    at 125 s
      4           5  Vote Timer Expiration: not approved
      4           7  Reconcile Begin: begun
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 4.1), not to 1 2 3 5
    at 130 s
      4          11  Reconcile Phase 1 Timer Expiration: no response
      4          20  Reconcile Finalize: done
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.2 on 1.1 4.1), not to 1 2 3 5
    at 140 s
      4           5  Vote Timer Expiration: approved; deque -4.2, chain +4.2 -> Commit Block (4.2 on 1.1 4.1), not to 1 2 3 5
      4           2  Process Next Deque Block: deque empty

150 s: end

    chains
      inception 1.1
        1.2  (1)
        2.1  (2)
        3.1 3.2  (3)
        4.1 4.2  (4)
        5.1  (5)
