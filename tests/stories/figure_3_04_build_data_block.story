# Figure 3.4, Build Data Block: events become data of the current block, until another of the largest size might not fit
# into it any more. Then the block is full, and the deque's.
agents: 2

# Each of these takes 256 bytes and 11 around them. A block has 1024 bytes, and the largest event takes 267.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: building

2 s: 1 logs

    at 2 s
      1           1  Build Data Block: building

3 s: 1 logs

    at 3 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2           3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2: yes
    at 13 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2           6  Receive Commit Block from 1: committed; chain +1.1

# The next event is of the next block, however large it is.
20 s: 1 logs 100 bytes

    at 20 s
      1           1  Build Data Block: building

30 s: end

    chains
      inception 1.1  (1 2)
