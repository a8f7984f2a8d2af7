# Figure 3.21, Receive Response Block for Hash: the block that was asked for is committed, and phase 2 goes on from there.
# Everybody who has it sends it: copies that come later are not asked for any more, or are of another block by then.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block
fates:
  - {message: Block Response, block: "2.1", sender: 3, receiver: 1, delay_s: 6}
  - {message: Block Response, block: "2.2", receiver: 1, delay_s: 2}

1 s: partition 1 | 2 3 4
2 s: 2 logs

    at 2 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1
      3 4         3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 3 4: yes
    at 12 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1
      2           2  Process Next Deque Block: deque empty
      3 4         6  Receive Commit Block from 2: committed; chain +2.1

14 s: 2 logs

    at 14 s
      2           1  Build Data Block: full; completes 2.2, deque +2.2
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.2 on 2.1), not to 1
      3 4         3  Receive Request Add Block from 2: approve -> Block Add Response (2.2: approve)
      2           4  Receive Vote Add Block from 3 4: yes
    at 24 s
      2           5  Vote Timer Expiration: approved; deque -2.2, chain +2.2 -> Commit Block (2.2 on 2.1), not to 1
      2           2  Process Next Deque Block: deque empty
      3 4         6  Receive Commit Block from 2: committed; chain +2.2

26 s: heal

# It hears of 2.1 from 2 and 4 at once, from 3 while it waits for 2.2.
30 s: reconcile 1

    at 30 s
      1           7  Reconcile Begin: begun
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
      1          18  Receive Response Block for Hash from 2 4: committed, not in phase 3; chain +2.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      2 3 4      13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (2.1: 2.2)
      1          14  Receive Response Next in Sequence from 2 3 4: new candidate, counted
    at 45 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.2)
      2 3 4      17  Receive Request Block for Hash from 1: sent -> Block Response (2.2)
    at 46 s
      1          18  Receive Response Block for Hash from 3: another block
    at 47 s
      1          18  Receive Response Block for Hash from 2 3 4: committed, not in phase 3; chain +2.2
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1 2.2)
      2 3 4      13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (2.1 2.2: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3 4: new candidate, counted
    at 52 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

80 s: end

    chains
      inception 2.1 2.2  (1 2 3 4)
