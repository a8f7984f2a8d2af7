# Figure 3.17, Receive Response Next in Sequence: an answer counts if the timer runs and it is about the chain asked about.
# Each different answer is a candidate, with a timestamp.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block
fates:
  - {message: Next in Sequence Response, sender: 4, receiver: 1, count: 1, delay_s: 7}  # when it has asked on
  - {message: Next in Sequence Response, sender: 3, receiver: 1, count: 2, delay_s: 7}  # when it asks no more

# 2, 3 and 4 commit a block; 5 has none of it, and neither has 1.
1 s: partition 1 | 5 | 2 3 4
2 s: 2 logs

    at 2 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1 5
      3 4         3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 3 4: yes
    at 12 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1 5
      2           2  Process Next Deque Block: deque empty
      3 4         6  Receive Commit Block from 2: committed; chain +2.1

14 s: heal

# Two name the block in time, and one says that there is nothing: two candidates.
20 s: reconcile 1

    at 20 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      2 3 4 5     9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (inception: yes)
      1          10  Receive Phase 1 Response from 2 3 4 5: yes
    at 25 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      2 3 4      13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (inception: 2.1)
      5          13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (inception: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3: new candidate, counted
      1          14  Receive Response Next in Sequence from 5: new candidate
    at 30 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      2 3 4      17  Receive Request Block for Hash from 1: sent -> Block Response (2.1)
      5          17  Receive Request Block for Hash from 1: not held
      1          18  Receive Response Block for Hash from 2 3 4: committed, not in phase 3; chain +2.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      2 3 4      13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      5          13  Receive Request Next in Sequence from 1: diverged
      5           7  Reconcile Begin: begun
      5           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1          14  Receive Response Next in Sequence from 2 4: new candidate, counted
      1           9  Receive Request Chain Contain from 5: reconcile in progress
      2 3 4       9  Receive Request Chain Contain from 5: yes -> Chain Contain Response (inception: yes)
      5          10  Receive Phase 1 Response from 2 3 4: yes
    at 32 s
      1          14  Receive Response Next in Sequence from 4: another chain
    at 35 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty
      5          11  Reconcile Phase 1 Timer Expiration: contained
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2 3 4    13  Receive Request Next in Sequence from 5: successor -> Next in Sequence Response (inception: 2.1)
      5          14  Receive Response Next in Sequence from 1 2 3 4: new candidate, counted
    at 37 s
      1          14  Receive Response Next in Sequence from 3: not in phase 2
    at 40 s
      5          15  Reconcile Phase 2 Timer Expiration: block
      5          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      1 2 3 4    17  Receive Request Block for Hash from 5: sent -> Block Response (2.1)
      5          18  Receive Response Block for Hash from 1 2 3 4: committed, not in phase 3; chain +2.1
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (2.1)
      1 2 3 4    13  Receive Request Next in Sequence from 5: top of chain -> Next in Sequence Response (2.1: Is Top Of Chain)
      5          14  Receive Response Next in Sequence from 1 2 3 4: new candidate, counted
    at 45 s
      5          15  Reconcile Phase 2 Timer Expiration: top of chain
      5          20  Reconcile Finalize: done
      5           2  Process Next Deque Block: deque empty

60 s: end

    chains
      inception 2.1  (1 2 3 4 5)
