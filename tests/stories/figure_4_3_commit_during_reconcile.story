# Figure 4.3, 15 percent loss: agent 1 is close to the end of phase 2 of a reconcile when agent 5 commits a block. It hears
# the commit, and does not follow. As it never reconciles again, it stays without the block (there 5.7, here 5.1).
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

1 s: 2 logs

    at 1 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception)
      1 3 4 5     3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 1 3 4 5: yes
    at 11 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception)
      2           2  Process Next Deque Block: deque empty
      1 3 4 5     6  Receive Commit Block from 2: committed; chain +2.1

20 s: 5 logs

    at 20 s
      5           1  Build Data Block: full; completes 5.1, deque +5.1
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on 2.1)
      1 2 3 4     3  Receive Request Add Block from 5: approve -> Block Add Response (5.1: approve)
      5           4  Receive Vote Add Block from 1 2 3 4: yes

21 s: reconcile 1

    at 21 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (2.1)
      2 3 4 5     9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (2.1: yes)
      1          10  Receive Phase 1 Response from 2 3 4 5: yes
    at 26 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      2 3 4 5    13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3 4 5: new candidate, counted
    at 30 s
      5           5  Vote Timer Expiration: approved; deque -5.1, chain +5.1 -> Commit Block (5.1 on 2.1)
      5           2  Process Next Deque Block: deque empty
      1           6  Receive Commit Block from 5: reconcile in progress
      2 3 4       6  Receive Commit Block from 5: committed; chain +5.1
    at 31 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

50 s: end

    chains
      inception 2.1  (1)
        5.1  (2 3 4 5)
