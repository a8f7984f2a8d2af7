# Figure 3.16, Receive Request Next in Sequence: the block that succeeds the chain hash, or that it is the top of the
# chain; and whoever does not have it has diverged, and reconciles, too.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block

# 4 does not hear of the first block, and commits another one by itself.
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
20 s: 4 does not reach 1 2 3
21 s: 4 logs

    at 21 s
      4           1  Build Data Block: full; completes 4.1, deque +4.1
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.1 on inception), not to 1 2 3
    at 31 s
      4           5  Vote Timer Expiration: approved; deque -4.1, chain +4.1 -> Commit Block (4.1 on inception), not to 1 2 3
      4           2  Process Next Deque Block: deque empty

35 s: 4 reaches 1 2 3 again

# 1 asks what follows 1.1: it is the top of the chain of 2; 4 does not have it at all; 3 reconciles, and says nothing.
40 s: reconcile 1

    at 40 s
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (1.1: yes)
      4           9  Receive Request Chain Contain from 1: no -> Chain Contain Response (1.1: no)
      1          10  Receive Phase 1 Response from 2 3: yes
      1          10  Receive Phase 1 Response from 4: no

41 s: reconcile 3

    at 41 s
      3           7  Reconcile Begin: begun
      3           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      1           9  Receive Request Chain Contain from 3: reconcile in progress
      2           9  Receive Request Chain Contain from 3: yes -> Chain Contain Response (1.1: yes)
      4           9  Receive Request Chain Contain from 3: no -> Chain Contain Response (1.1: no)
      3          10  Receive Phase 1 Response from 2: yes
      3          10  Receive Phase 1 Response from 4: no
    at 45 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      2          13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      3          13  Receive Request Next in Sequence from 1: reconcile in progress
      4          13  Receive Request Next in Sequence from 1: diverged
      4           7  Reconcile Begin: begun
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (4.1)
      1          14  Receive Response Next in Sequence from 2: new candidate
      1 3         9  Receive Request Chain Contain from 4: reconcile in progress
      2           9  Receive Request Chain Contain from 4: no -> Chain Contain Response (4.1: no)
      4          10  Receive Phase 1 Response from 2: no
    at 46 s
      3          11  Reconcile Phase 1 Timer Expiration: contained
      3          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 4        13  Receive Request Next in Sequence from 3: reconcile in progress
      2          13  Receive Request Next in Sequence from 3: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      3          14  Receive Response Next in Sequence from 2: new candidate

# 4 reconciles, too. What follows the inception block in the chains of 2 and 3 is 1.1.
47 s: 4 does not reach 1

    at 50 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done
      1           2  Process Next Deque Block: deque empty
      4          11  Reconcile Phase 1 Timer Expiration: not contained; chain -4.1, stack +4.1
      4           8  Reconcile Phase 1: asked -> Chain Contain Query (inception), not to 1
      2           9  Receive Request Chain Contain from 4: yes -> Chain Contain Response (inception: yes)
      3           9  Receive Request Chain Contain from 4: reconcile in progress
      4          10  Receive Phase 1 Response from 2: yes
    at 51 s
      3          15  Reconcile Phase 2 Timer Expiration: top of chain
      3          20  Reconcile Finalize: done
      3           2  Process Next Deque Block: deque empty
    at 55 s
      4          11  Reconcile Phase 1 Timer Expiration: contained
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception), not to 1
      2 3        13  Receive Request Next in Sequence from 4: successor -> Next in Sequence Response (inception: 1.1)
      4          14  Receive Response Next in Sequence from 2 3: new candidate, counted
    at 60 s
      4          15  Reconcile Phase 2 Timer Expiration: block
      4          16  Reconcile Phase 3: asked -> Request for Block (1.1), not to 1
      2 3        17  Receive Request Block for Hash from 4: sent -> Block Response (1.1)
      4          18  Receive Response Block for Hash from 2 3: committed, not in phase 3; chain +1.1
      4          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1), not to 1
      2 3        13  Receive Request Next in Sequence from 4: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      4          14  Receive Response Next in Sequence from 2 3: new candidate, counted
    at 65 s
      4          15  Reconcile Phase 2 Timer Expiration: top of chain
      4          20  Reconcile Finalize: done; stack -4.1, chain +4.1 -> Commit Block (4.1 on 1.1), not to 1
      4           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 4: committed; chain +4.1

100 s: end

    chains
      inception 1.1  (1)
        4.1  (2 3 4)
