# Figure 3.13, Receive Phase 1 Response: answers are counted while the phase 1 timer runs and the chain is the one asked
# about.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block
fates:
  - {message: Chain Contain Response, sender: 4, receiver: 1, count: 1, delay_s: 7}  # after phase 1, which takes 5 s
  - {message: Chain Contain Response, sender: 4, receiver: 2, count: 2, delay_s: 6}  # when it is asked about another

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.1

# Two answers are in time, the third is late.
20 s: reconcile 1

    at 20 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      2 3 4       9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (1.1: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 25 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      2 3 4      13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3 4: new candidate, counted
    at 27 s
      1          10  Receive Phase 1 Response from 4: not in phase 1
    at 30 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty

# An answer to the first question comes when the second, about a shorter chain, has been asked.
50 s: partition 2 | 1 3 4
51 s: 2 logs

    at 51 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 1.1), not to 1 3 4
    at 61 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 1.1), not to 1 3 4
      2           2  Process Next Deque Block: deque empty

63 s: heal
70 s: reconcile 2

    at 70 s
      2           7  Reconcile Begin: begun
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 2.1)
      1 3 4       9  Receive Request Chain Contain from 2: no -> Chain Contain Response (1.1 2.1: no)
      2          10  Receive Phase 1 Response from 1 3: no
    at 75 s
      2          11  Reconcile Phase 1 Timer Expiration: not contained; chain -2.1, stack +2.1
      2           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      1 3 4       9  Receive Request Chain Contain from 2: yes -> Chain Contain Response (1.1: yes)
      2          10  Receive Phase 1 Response from 1 3 4: yes
    at 76 s
      2          10  Receive Phase 1 Response from 4: another chain
    at 80 s
      2          11  Reconcile Phase 1 Timer Expiration: contained
      2          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 3 4      13  Receive Request Next in Sequence from 2: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      2          14  Receive Response Next in Sequence from 1 3 4: new candidate, counted
    at 85 s
      2          15  Reconcile Phase 2 Timer Expiration: top of chain
      2          20  Reconcile Finalize: done; stack -2.1, chain +2.1 -> Commit Block (2.1 on 1.1)
      2           2  Process Next Deque Block: deque empty
      1 3 4       6  Receive Commit Block from 2: committed; chain +2.1

110 s: end

    chains
      inception 1.1 2.1  (1 2 3 4)
