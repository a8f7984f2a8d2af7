# Figure 3.6, Receive Request Add Block: whoever has the proposer's top chain hash approves, whoever has another one
# disapproves, and whoever reconciles says nothing.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block

# 4 does not hear of the first block.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4: yes

8 s: 1 does not reach 4

    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 4
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.1

15 s: 1 reaches 4 again

# Of the second it is asked while 3 reconciles: 2 approves, 4 disapproves, 3 is silent.
20 s: reconcile 3

    at 20 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      1 2         9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (1.1: yes)
      4           9  Receive Request Chain Contain from 3: no -> Chain Contain Response (1.1: no)
      3          10  Receive Phase 1 Response from 1 2: yes
      3          10  Receive Phase 1 Response from 4: no

21 s: 1 logs

    at 21 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1)
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.2: approve)
      3           3  Receive Request Add Block from 1: reconcile in progress
      4           3  Receive Request Add Block from 1: disapprove -> Block Add Response (1.2: disapprove)
      1           4  Receive Vote Add Block from 2: yes
      1           4  Receive Vote Add Block from 4: no
    at 25 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 2        13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      4          13  Receive Request Next in Sequence from 3: diverged
      4           7  Reconcile Begin: begun
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2         9  Receive Request Chain Contain from 4: yes -> Chain Contain Response (inception: yes)
      3          14  Receive Response Next in Sequence from 1 2: new candidate, counted
      3           9  Receive Request Chain Contain from 4: reconcile in progress
      4          10  Receive Phase 1 Response from 1 2: yes
    at 30 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done
      3           2  Process Next Deque Block: deque empty
      4          11  Reconcile Phase 1 Timer Expiration: contained
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2 3      13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (inception: 1.1)
      4          14  Receive Response Next in Sequence from 1 2 3: new candidate, counted
    at 31 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.2
      4           6  Receive Commit Block from 1: reconcile in progress
    at 35 s
      4          15  Reconcile Phase 2 Timer Expiration: block
      4          16  Reconcile Phase 3: asked -> Request for Block (1.1)
      1 2 3      17  Receive Request Block for Hash from 4: sent -> Block Response (1.1)
      4          18  Receive Response Block for Hash from 1 2 3: committed, not in phase 3; chain +1.1
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 2 3      13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (1.1: 1.2)
      4          14  Receive Response Next in Sequence from 1 2 3: new candidate, counted
    at 40 s
      4          15  Reconcile Phase 2 Timer Expiration: block
      4          16  Reconcile Phase 3: asked -> Request for Block (1.2)
      1 2 3      17  Receive Request Block for Hash from 4: sent -> Block Response (1.2)
      4          18  Receive Response Block for Hash from 1 2 3: committed, not in phase 3; chain +1.2
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 1.2)
      1 2 3      13  Receive Request Next in Sequence from 4: top of chain -> Next in Sequence Response (1.1 1.2: Is Top Of Chain)
      4          14  Receive Response Next in Sequence from 1 2 3: new candidate, counted
    at 45 s
      4          15  Reconcile Phase 2 Timer Expiration: top of chain
      4          20  Reconcile Finalize: done
      4           2  Process Next Deque Block: deque empty

60 s: end

    chains
      inception 1.1 1.2  (1 2 3 4)
