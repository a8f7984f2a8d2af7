# Figure 4.6, 100 percent loss: nobody hears anybody. Each counts its own approval, so each commits its own blocks, nobody
# reconciles, and all that the chains have in common is the inception block.
agents: 5
settings: {max_block_bytes: 267}  # an event fills a block
network: {loss: 1.0}

1 s: 1 2 3 4 5 log

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception), not to 2 3 4 5
      2           1  Build Data Block: full; completes 2.1, deque +2.1
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.1 on inception), not to 1 3 4 5
      3           1  Build Data Block: full; completes 3.1, deque +3.1
      3           2  Process Next Deque Block: proposed -> Block Add Request (3.1 on inception), not to 1 2 4 5
      4           1  Build Data Block: full; completes 4.1, deque +4.1
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.1 on inception), not to 1 2 3 5
      5           1  Build Data Block: full; completes 5.1, deque +5.1
      5           2  Process Next Deque Block: proposed -> Block Add Request (5.1 on inception), not to 1 2 3 4
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception), not to 2 3 4 5
      1           2  Process Next Deque Block: deque empty
      2           5  Vote Timer Expiration: approved; deque -2.1, chain +2.1 -> Commit Block (2.1 on inception), not to 1 3 4 5
      2           2  Process Next Deque Block: deque empty
      3           5  Vote Timer Expiration: approved; deque -3.1, chain +3.1 -> Commit Block (3.1 on inception), not to 1 2 4 5
      3           2  Process Next Deque Block: deque empty
      4           5  Vote Timer Expiration: approved; deque -4.1, chain +4.1 -> Commit Block (4.1 on inception), not to 1 2 3 5
      4           2  Process Next Deque Block: deque empty
      5           5  Vote Timer Expiration: approved; deque -5.1, chain +5.1 -> Commit Block (5.1 on inception), not to 1 2 3 4
      5           2  Process Next Deque Block: deque empty

20 s: 2 4 log

    at 20 s
      2           1  Build Data Block: full; completes 2.2, deque +2.2
      2           2  Process Next Deque Block: proposed -> Block Add Request (2.2 on 2.1), not to 1 3 4 5
      4           1  Build Data Block: full; completes 4.2, deque +4.2
      4           2  Process Next Deque Block: proposed -> Block Add Request (4.2 on 4.1), not to 1 2 3 5
    at 30 s
      2           5  Vote Timer Expiration: approved; deque -2.2, chain +2.2 -> Commit Block (2.2 on 2.1), not to 1 3 4 5
      2           2  Process Next Deque Block: deque empty
      4           5  Vote Timer Expiration: approved; deque -4.2, chain +4.2 -> Commit Block (4.2 on 4.1), not to 1 2 3 5
      4           2  Process Next Deque Block: deque empty

40 s: end

    chains
      inception
        1.1  (1)
        2.1 2.2  (2)
        3.1  (3)
        4.1 4.2  (4)
        5.1  (5)
