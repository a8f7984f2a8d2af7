# Figure 3.23, Reconcile Finalize: what is left on the stack goes back on top of the chain, block by block, and each is
# broadcast; then comes whatever has filled the deque meanwhile.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

1 s: partition 1 | 2 3
2 s: 1 logs

    at 2 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception), not to 2 3
    at 12 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 2 3
      1           2  Process Next Deque Block: deque empty

14 s: 1 logs

    at 14 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1), not to 2 3
    at 24 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1), not to 2 3
      1           2  Process Next Deque Block: deque empty

26 s: heal
30 s: reconcile 1

    at 30 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 1.2)
      2 3         9  Receive Request Chain Contain from 1: no -> Chain Contain Response (1.1 1.2: no)
      1          10  Receive Phase 1 Response from 2 3: no
    at 35 s
      1          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.2, stack +1.2
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      2 3         9  Receive Request Chain Contain from 1: no -> Chain Contain Response (1.1: no)
      1          10  Receive Phase 1 Response from 2 3: no

# A block that is completed meanwhile waits.
36 s: 1 logs

    at 36 s
      1           1  Build Data Block: full; completes 1.3, deque +1.3
      1           2  Process Next Deque Block: reconcile in progress
    at 40 s
      1          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.1, stack +1.1
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 45 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2 3        13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (inception: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3: new candidate, counted
    at 50 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: recommitted, more to come; stack -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1          20  Reconcile Finalize: done; stack -1.2, chain +1.2 -> Commit Block (1.2 on 1.1)
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.3 on 1.1 1.2)
      2 3         6  Receive Commit Block from 1: committed; chain +1.1
      2 3         6  Receive Commit Block from 1: committed; chain +1.2
      2 3         3  Receive Request Add Block from 1: approve -> Block Add Response (1.3: approve)
      1           4  Receive Vote Add Block from 2 3: yes
    at 60 s
      1           5  Vote Timer Expiration: approved; deque -1.3, chain +1.3 -> Commit Block (1.3 on 1.1 1.2)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.3

70 s: end

    chains
      inception 1.1 1.2 1.3  (1 2 3)
