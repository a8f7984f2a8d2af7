# Figure 3.14, Reconcile Phase 1 Timer Expiration: nobody answered, and the reconcile is over; most do not have the chain,
# and its top block goes to the stack; or they do, and it is the mutual chain.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

1 s: partition 3 | 1 2
2 s: 3 logs

    at 2 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on inception), not to 1 2
    at 12 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on inception), not to 1 2
      3           2  Process Next Deque Block: deque empty

# Nobody answers.
20 s: reconcile 3

    at 20 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (3.1), not to 1 2
    at 25 s
      3          11  Reconcile Phase 1 Timer Expiration: no response
      3          20  Reconcile Finalize: done
      3           2  Process Next Deque Block: deque empty

# Not contained, then contained.
30 s: heal
35 s: reconcile 3

    at 35 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (3.1)
      1 2         9  Receive Request Chain Contain from 3: no -> Chain Contain Response (3.1: no)
      3          10  Receive Phase 1 Response from 1 2: no
    at 40 s
      3          11  Reconcile Phase 1 Timer Expiration: not contained; chain -3.1, stack +3.1
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (inception: yes)
      3          10  Receive Phase 1 Response from 1 2: yes
    at 45 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (inception: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
    at 50 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done; stack -3.1, chain +3.1 -> Commit Block (3.1 on inception)
      3           2  Process Next Deque Block: deque empty
      1 2         6  Receive Commit Block from 3: committed; chain +3.1

70 s: end

    chains
      inception 3.1  (1 2 3)
