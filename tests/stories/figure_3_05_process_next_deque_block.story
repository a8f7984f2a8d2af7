# Figure 3.5, Process Next Deque Block: the first block of the deque is proposed, if there is one, no reconcile is in
# progress, and no vote runs.
agents: 2
settings: {max_block_bytes: 267}  # an event fills a block

# Two more blocks wait while the vote on the first runs: the one that was there before is the next.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2: yes

3 s: 1 logs

    at 3 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: vote running

5 s: 1 logs

    at 5 s
      1           1  Build Data Block: full; completes 1.3, deque +1.3
      1           2  Process Next Deque Block: vote running
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1)
      2           6  Receive Commit Block from 1: committed; chain +1.1
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.2: approve)
      1           4  Receive Vote Add Block from 2: yes
    at 21 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1)
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.3 on 1.1 1.2)
      2           6  Receive Commit Block from 1: committed; chain +1.2
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.3: approve)
      1           4  Receive Vote Add Block from 2: yes
    at 31 s
      1           5  Vote Timer Expiration: approved; deque -1.3, chain +1.3 -> Commit Block (1.3 on 1.1 1.2)
      1           2  Process Next Deque Block: deque empty
      2           6  Receive Commit Block from 1: committed; chain +1.3

# It waits while its agent reconciles, too.
40 s: reconcile 1

    at 40 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 1.2 1.3)
      2           9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (1.1 1.2 1.3: yes)
      1          10  Receive Phase 1 Response from 2: yes

42 s: 1 logs

    at 42 s
      1           1  Build Data Block: full; completes 1.4, deque +1.4
      1           2  Process Next Deque Block: reconcile in progress
    at 45 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 1.2 1.3)
      2          13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (1.1 1.2 1.3: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2: new candidate
    at 50 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.4 on 1.1 1.2 1.3)
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.4: approve)
      1           4  Receive Vote Add Block from 2: yes
    at 60 s
      1           5  Vote Timer Expiration: approved; deque -1.4, chain +1.4 -> Commit Block (1.4 on 1.1 1.2 1.3)
      1           2  Process Next Deque Block: deque empty
      2           6  Receive Commit Block from 1: committed; chain +1.4

70 s: end

    chains
      inception 1.1 1.2 1.3 1.4  (1 2)
