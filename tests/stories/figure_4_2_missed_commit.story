# Figure 4.2, commits that are missed: chains part, a vote finds out, and a reconcile brings them together again. At the end
# agent 2 misses the commit of agent 4's last block. Nobody votes after that, so it stays without it (there 4.11, here 4.2).
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

# 5 misses a commit, and loses the vote on its next block.
1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4 5     3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4 5: yes

8 s: 1 does not reach 5

    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 5
      1           2  Process Next Deque Block: deque empty
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.1

15 s: 1 reaches 5 again
20 s: 5 logs

    at 20 s
      5           1  Build Data Block: full; completes 5.1, deque +5.1
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on inception)
      1 2 3 4     3  Receive Request Add Block from 5: disapprove -> Block Add Response (5.1: disapprove)
      5           4  Receive Vote Add Block from 1 2 3 4: no
    at 30 s
      5           5  Vote Timer Expiration: not approved
      5           7  Reconcile Begin: begun
      5           8  Reconcile Phase 1: asked -> Chain Contain Query (inception)
      1 2 3 4     9  Receive Request Chain Contain from 5: yes -> Chain Contain Response (inception: yes)
      5          10  Receive Phase 1 Response from 1 2 3 4: yes
    at 35 s
      5          11  Reconcile Phase 1 Timer Expiration: contained
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (inception)
      1 2 3 4    13  Receive Request Next in Sequence from 5: successor -> Next in Sequence Response (inception: 1.1)
      5          14  Receive Response Next in Sequence from 1 2 3 4: new candidate, counted
    at 40 s
      5          15  Reconcile Phase 2 Timer Expiration: block
      5          16  Reconcile Phase 3: asked -> Request for Block (1.1)
      1 2 3 4    17  Receive Request Block for Hash from 5: sent -> Block Response (1.1)
      5          18  Receive Response Block for Hash from 1 2 3 4: committed, not in phase 3; chain +1.1
      5          12  Reconcile Phase 2: asked -> Chain Hash Successor Query (1.1)
      1 2 3 4    13  Receive Request Next in Sequence from 5: top of chain -> Next in Sequence Response (1.1: Is Top Of Chain)
      5          14  Receive Response Next in Sequence from 1 2 3 4: new candidate, counted
    at 45 s
      5          15  Reconcile Phase 2 Timer Expiration: top of chain
      5          20  Reconcile Finalize: done
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on 1.1)
      1 2 3 4     3  Receive Request Add Block from 5: approve -> Block Add Response (5.1: approve)
      5           4  Receive Vote Add Block from 1 2 3 4: yes
    at 55 s
      5           5  Vote Timer Expiration: approved; deque -5.1, chain +5.1 -> Commit Block (5.1 on 1.1)
      5           2  Process Next Deque Block: deque empty
      1 2 3 4     6  Receive Commit Block from 5: committed; chain +5.1

80 s: 4 logs

    at 80 s
      4           1  Build Data Block: full; completes 4.1, deque +4.1
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.1 on 1.1 5.1)
      1 2 3 5     3  Receive Request Add Block from 4: approve -> Block Add Response (4.1: approve)
      4           4  Receive Vote Add Block from 1 2 3 5: yes
    at 90 s
      4           5  Vote Timer Expiration: approved; deque -4.1, chain +4.1 -> Commit Block (4.1 on 1.1 5.1)
      4           2  Process Next Deque Block: deque empty
      1 2 3 5     6  Receive Commit Block from 4: committed; chain +4.1

100 s: 4 logs

    at 100 s
      4           1  Build Data Block: full; completes 4.2, deque +4.2
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.2 on 1.1 5.1 4.1)
      1 2 3 5     3  Receive Request Add Block from 4: approve -> Block Add Response (4.2: approve)
      4           4  Receive Vote Add Block from 1 2 3 5: yes

108 s: 4 does not reach 2

    at 110 s
      4           5  Vote Timer Expiration: approved; deque -4.2, chain +4.2 -> Commit Block (4.2 on 1.1 5.1 4.1), not to 2
      4           2  Process Next Deque Block: deque empty
      1 3 5       6  Receive Commit Block from 4: committed; chain +4.2

115 s: 4 reaches 2 again
120 s: end

    chains
      inception 1.1 5.1 4.1  (2)
        4.2  (1 3 4 5)
