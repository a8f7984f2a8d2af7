# Figure 4.1, nothing is lost: one chain, and no reconcile. Where the chain was altered while a vote was in progress, the
# vote is held again, until the block is committed.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4 5     3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3 4 5: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3 4 5     6  Receive Commit Block from 1: committed; chain +1.1

20 s: 4 logs

    at 20 s
      4           1  Build Data Block: full; completes 4.1, deque +4.1
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.1 on 1.1)
      1 2 3 5     3  Receive Request Add Block from 4: approve -> Block Add Response (4.1: approve)
      4           4  Receive Vote Add Block from 1 2 3 5: yes
    at 30 s
      4           5  Vote Timer Expiration: approved; deque -4.1, chain +4.1 -> Commit Block (4.1 on 1.1)
      4           2  Process Next Deque Block: deque empty
      1 2 3 5     6  Receive Commit Block from 4: committed; chain +4.1

# 3 and 5 propose on the same chain; all approve of both; 3 is first, and 5 votes again.
40 s: 3 logs

    at 40 s
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on 1.1 4.1)
      1 2 4 5     3  Receive Request Add Block from 3: approve -> Block Add Response (3.1: approve)
      3           4  Receive Vote Add Block from 1 2 4 5: yes

43 s: 5 logs

    at 43 s
      5           1  Build Data Block: full; completes 5.1, deque +5.1
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on 1.1 4.1)
      1 2 3 4     3  Receive Request Add Block from 5: approve -> Block Add Response (5.1: approve)
      5           4  Receive Vote Add Block from 1 2 3 4: yes
    at 50 s
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on 1.1 4.1)
      3           2  Process Next Deque Block: deque empty
      1 2 4 5     6  Receive Commit Block from 3: committed; chain +3.1
    at 53 s
      5           5  Vote Timer Expiration: chain changed
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on 1.1 4.1 3.1)
      1 2 3 4     3  Receive Request Add Block from 5: approve -> Block Add Response (5.1: approve)
      5           4  Receive Vote Add Block from 1 2 3 4: yes
    at 63 s
      5           5  Vote Timer Expiration: approved; deque -5.1, chain +5.1 -> Commit Block (5.1 on 1.1 4.1 3.1)
      5           2  Process Next Deque Block: deque empty
      1 2 3 4     6  Receive Commit Block from 5: committed; chain +5.1

80 s: end

    chains
      inception 1.1 4.1 3.1 5.1  (1 2 3 4 5)
