# Figure 3.2, an abstracted version of UCP: a block is generated, committed, and, as the chains have parted,
# reconciled, by phases 1, 2 and 3, and finalized.
agents: 3
settings: {max_block_bytes: 267}  # an event fills a block

# Generate a Block, and Commit Block: the vote is unanimous, and the commit reaches everybody.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3         3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.1

# What 2 and 3 commit now, 1 does not hear, and they do not hear what it commits.
20 s: partition 1 | 2 3
25 s: 1 logs

    at 25 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1), not to 2 3

26 s: 2 logs

    at 26 s
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on 1.1), not to 1
      3           3  Receive Request Add Block from 2: approve -> Block Add Response (2.1: approve)
      2           4  Receive Vote Add Block from 3: yes
    at 35 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1), not to 2 3
      1           2  Process Next Deque Block: deque empty
    at 36 s
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on 1.1), not to 1
      2           2  Process Next Deque Block: deque empty
      3           6  Receive Commit Block from 2: committed; chain +2.1

40 s: heal

# Reconcile: 1 asks for the next block, nobody approves, and it finds its chain to be another one than theirs. Phase 1
# takes its own block away, phase 2 names the block that the others have in its place, phase 3 brings it, and then its
# own block goes on top, for everybody.
45 s: 1 logs

    at 45 s
      1           1  Build Data Block: full; completes 1.3, deque +1.3
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.3 on 1.1 1.2)
      2 3         3  Receive Request Add Block from 1: disapprove -> Block Add Response (1.3: disapprove)
      1           4  Receive Vote Add Block from 2 3: no
    at 55 s
      1           5  Vote Timer Expiration: not approved
      1           7  Reconcile Begin: begun
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1 1.2)
      2 3         9  Receive Request Chain Contain from 1: no -> Chain Contain Response (1.1 1.2: no)
      1          10  Receive Phase 1 Response from 2 3: no
    at 60 s
      1          11  Reconcile Phase 1 Timer Expiration: not contained; chain -1.2, stack +1.2
      1           8  Reconcile Phase 1: asked -> Chain Contain Query (1.1)
      2 3         9  Receive Request Chain Contain from 1: yes -> Chain Contain Response (1.1: yes)
      1          10  Receive Phase 1 Response from 2 3: yes
    at 65 s
      1          11  Reconcile Phase 1 Timer Expiration: contained
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      2 3        13  Receive Request Next in Sequence from 1: successor -> Next in Sequence Response (1.1: 2.1)
      1          14  Receive Response Next in Sequence from 2 3: new candidate, counted
    at 70 s
      1          15  Reconcile Phase 2 Timer Expiration: block
      1          16  Reconcile Phase 3: asked -> Request for Block (2.1)
      2 3        17  Receive Request Block for Hash from 1: sent -> Block Response (2.1)
      1          18  Receive Response Block for Hash from 2 3: committed, not in phase 3; chain +2.1
      1          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1 2.1)
      2 3        13  Receive Request Next in Sequence from 1: top of chain -> Next in Sequence Response (1.1 2.1: Is Top Of Chain)
      1          14  Receive Response Next in Sequence from 2 3: new candidate, counted
    at 75 s
      1          15  Reconcile Phase 2 Timer Expiration: top of chain
      1          20  Reconcile Finalize: done; stack -1.2, chain +1.2 -> Commit Block (1.2 on 1.1 2.1)
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.3 on 1.1 2.1 1.2)
      2 3         6  Receive Commit Block from 1: committed; chain +1.2
      2 3         3  Receive Request Add Block from 1: approve -> Block Add Response (1.3: approve)
      1           4  Receive Vote Add Block from 2 3: yes
    at 85 s
      1           5  Vote Timer Expiration: approved; deque -1.3, chain +1.3 -> Commit Block (1.3 on 1.1 2.1 1.2)
      1           2  Process Next Deque Block: deque empty
      2 3         6  Receive Commit Block from 1: committed; chain +1.3

120 s: end

    chains
      inception 1.1 2.1 1.2 1.3  (1 2 3)
