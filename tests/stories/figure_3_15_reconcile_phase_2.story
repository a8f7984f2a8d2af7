# Figure 3.15, Reconcile Phase 2: what follows the mutual chain? It is asked again for each block that has been added.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

1 s: partition 3 | 1 2
2 s: 1 logs

    at 2 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception), not to 3
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2: yes
    at 12 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 3
      1           2  Process Next Deque Block: deque empty
      2           6  Receive Commit Block from 1: committed; chain +1.1

14 s: 1 logs

    at 14 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1), not to 3
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.2: approve)
      1           4  Receive Vote Add Block from 2: yes
    at 24 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1), not to 3
      1           2  Process Next Deque Block: deque empty
      2           6  Receive Commit Block from 1: committed; chain +1.2

28 s: heal
30 s: reconcile 3

    at 30 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (inception: yes)
      3          10  Receive Phase 1 Response from 1 2: yes
    at 35 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2        13  Receive Request Next in Sequence from 3: successor -> Next in Sequence Response (inception: 1.1)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 40 s
      3          15  Reconcile Phase 2 Timer Expiration: block
      3          16  Reconcile Phase 3: asked -> Request for Block (1.1)
      1 2        17  Receive Request Block for Hash from 3: sent -> Block Response (1.1)
      3          18  Receive Response Block for Hash from 1 2: committed, not in phase 3; chain +1.1
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 2        13  Receive Request Next in Sequence from 3: successor -> Next in Sequence Response (1.1: 1.2)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 45 s
      3          15  Reconcile Phase 2 Timer Expiration: block
      3          16  Reconcile Phase 3: asked -> Request for Block (1.2)
      1 2        17  Receive Request Block for Hash from 3: sent -> Block Response (1.2)
      3          18  Receive Response Block for Hash from 1 2: committed, not in phase 3; chain +1.2
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 1.2)
      1 2        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (1.1 1.2: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 50 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done
      3           2  Process Next Deque Block: deque empty

70 s: end

    chains
      inception 1.1 1.2  (1 2 3)
