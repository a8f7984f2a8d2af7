# Figure 3.7, Receive Vote Add Block: a vote counts if the timer runs and the block is the candidate. Everybody hears all
# votes; those on the blocks of others are not told here.
agents: 4
settings: {max_block_bytes: 267}  # an event fills a block
fates:
  - {message: Block Add Response, block: "1.1", sender: 4, delay_s: 12}  # after the vote
  - {message: Block Add Response, block: "1.2", sender: 4, delay_s: 12}  # during the next one

# Two vote in time, and the third when no vote runs any more.

1 s: 1 logs

    at 1 s
      1           1  Build Data Block: full; completes 1.1, deque +1.1
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.1 on inception)
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.1: approve)
      1           4  Receive Vote Add Block from 2 3: yes
    at 11 s
      1           5  Vote Timer Expiration: approved; deque -1.1, chain +1.1 -> Commit Block (1.1 on inception)
      1           2  Process Next Deque Block: deque empty
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.1
    at 13 s
      1           4  Receive Vote Add Block from 4: no vote running

# The third votes on a block while the vote on the next one runs: another block.
20 s: 1 logs

    at 20 s
      1           1  Build Data Block: full; completes 1.2, deque +1.2
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.2 on 1.1)
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.2: approve)
      1           4  Receive Vote Add Block from 2 3: yes

25 s: 1 logs

    at 25 s
      1           1  Build Data Block: full; completes 1.3, deque +1.3
      1           2  Process Next Deque Block: vote running
    at 30 s
      1           5  Vote Timer Expiration: approved; deque -1.2, chain +1.2 -> Commit Block (1.2 on 1.1)
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.3 on 1.1 1.2)
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.2
      2 3 4       3  Receive Request Add Block from 1: approve -> Block Add Response (1.3: approve)
      1           4  Receive Vote Add Block from 2 3 4: yes
    at 32 s
      1           4  Receive Vote Add Block from 4: another block
    at 40 s
      1           5  Vote Timer Expiration: approved; deque -1.3, chain +1.3 -> Commit Block (1.3 on 1.1 1.2)
      1           2  Process Next Deque Block: deque empty
      2 3 4       6  Receive Commit Block from 1: committed; chain +1.3

# Who has another chain disapproves.
60 s: 1 does not reach 3
61 s: 1 logs

    at 61 s
      1           1  Build Data Block: full; completes 1.4, deque +1.4
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.4 on 1.1 1.2 1.3), not to 3
      2 4         3  Receive Request Add Block from 1: approve -> Block Add Response (1.4: approve)
      1           4  Receive Vote Add Block from 2 4: yes
    at 71 s
      1           5  Vote Timer Expiration: approved; deque -1.4, chain +1.4 -> Commit Block (1.4 on 1.1 1.2 1.3), not to 3
      1           2  Process Next Deque Block: deque empty
      2 4         6  Receive Commit Block from 1: committed; chain +1.4

75 s: 1 reaches 3 again
80 s: 1 logs

    at 80 s
      1           1  Build Data Block: full; completes 1.5, deque +1.5
      1           2  Process Next Deque Block: proposed -> Block Add Request (1.5 on 1.1 1.2 1.3 1.4)
      2 4         3  Receive Request Add Block from 1: approve -> Block Add Response (1.5: approve)
      3           3  Receive Request Add Block from 1: disapprove -> Block Add Response (1.5: disapprove)
      1           4  Receive Vote Add Block from 2 4: yes
      1           4  Receive Vote Add Block from 3: no
    at 90 s
      1           5  Vote Timer Expiration: approved; deque -1.5, chain +1.5 -> Commit Block (1.5 on 1.1 1.2 1.3 1.4)
      1           2  Process Next Deque Block: deque empty
      2 4         6  Receive Commit Block from 1: committed; chain +1.5
      3           6  Receive Commit Block from 1: does not succeed

110 s: end

    chains
      inception 1.1 1.2 1.3  (3)
        1.4 1.5  (1 2 4)
