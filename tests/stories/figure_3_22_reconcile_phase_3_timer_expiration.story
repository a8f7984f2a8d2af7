# Figure 3.22, Reconcile Phase 3 Timer Expiration: the block does not come, and the reconcile is over.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

1 s: partition 1 | 2 3
2 s: 2 logs

    at 2 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1
      3           3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 3: yes
    at 12 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1
      2           2  Process Next Deque Block: deque empty
      3           6  Receive Commit Block from 2: committed; chain +2.1

14 s: heal

# 1 is told of the block, and then nobody hears it ask for it.
20 s: reconcile 1

    at 20 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 25 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2 3        13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 2.1)
      1          14  Receive Response Next in Sequence from 2 3: new candidate, counted

28 s: 1 does not reach 2 3

    at 30 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.1), not to 2 3
    at 35 s
      1          19  Reconcile Phase 3 Timer Expiration: gave up
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

45 s: 1 reaches 2 3 again
50 s: end

    chains
      inception  (1)
        2.1  (2 3)
