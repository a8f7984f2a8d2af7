# Figure 4.7, the second field test: 32 dies of a tie in phase 2 and does nothing from then on; 120 gives phase 3 up before
# the block comes, so its mutual chain is shorter than it could be; 10 and 28 are right. (All six aircraft, and the whole
# flight: scenarios/field_test_2020.yaml.)
agents: [10, 28, 32, 120]
settings: {max_block_bytes: 267}  # an event fills a block
quirks:
  crash_on_tie: {agents: [32]}
  early_phase3_expiry: {agents: [120]}
settle: {limit_s: 60}
expect:
  characteristics: {1: violated, 5: violated, 6: violated}
  steps: deviates
  liveness: never finishes

1 s: 10 logs

    at 1 s
      10          1  Build Data Block: full; completes 10.1, deque +10.1
      10          2  Process Next Deque Block: proposed -> Block Add Request (10.1 on inception)
      28 32 120   3  Receive Request Add Block from 10: approve -> Block Add Response (10.1: approve)
      10          4  Receive Vote Add Block from 28 32 120: yes
    at 11 s
      10          5  Vote Timer Expiration: approved; deque -10.1, chain +10.1 -> Commit Block (10.1 on inception)
      10          2  Process Next Deque Block: deque empty
      28 32 120   6  Receive Commit Block from 10: committed; chain +10.1

# 120 does not hear of a block of 28, and cannot wait for it when it reconciles.
20 s: partition 120 | 10 28 32
21 s: 28 logs

    at 21 s
      28          1  Build Data Block: full; completes 28.1, deque +28.1
      28          2  Process Next Deque Block: proposed -> Block Add Request (28.1 on 10.1), not to 120
      10 32       3  Receive Request Add Block from 28: approve -> Block Add Response (28.1: approve)
      28          4  Receive Vote Add Block from 10 32: yes
    at 31 s
      28          5  Vote Timer Expiration: approved; deque -28.1, chain +28.1 -> Commit Block (28.1 on 10.1), not to 120
      28          2  Process Next Deque Block: deque empty
      10 32       6  Receive Commit Block from 28: committed; chain +28.1

40 s: heal
45 s: reconcile 120

    at 45 s
      120         7  Reconcile Begin: begun
      120         8  Reconcile Phase 1: asked -> Chain Contain Query (10.1)
      10 28 32    9  Receive Request Chain Contain from 120: yes -> Chain Contain Response (10.1: yes)
      120        10  Receive Phase 1 Response from 10 28 32: yes
    at 50 s
      120        11  Reconcile Phase 1 Timer Expiration: contained
      120        12  Reconcile Phase 2: asked -> Chain Hash Successor Query (10.1)
      10 28 32   13  Receive Request Next in Sequence from 120: successor -> Next in Sequence Response (10.1: 28.1)
      120        14  Receive Response Next in Sequence from 10 28 32: new candidate, counted
    at 55 s
      120        15  Reconcile Phase 2 Timer Expiration: block
      120        16  Reconcile Phase 3: asked -> Request for Block (28.1)
      120        19  Reconcile Phase 3 Timer Expiration: gave up
      120        20  Reconcile Finalize: done
      120         2  Process Next Deque Block: deque empty
      10 28 32   17  Receive Request Block for Hash from 120: sent -> Block Response (28.1)
      120        18  Receive Response Block for Hash from 10 28 32: not in phase 3

# 32 hears of two chains, one as often as the other.
80 s: partition 32 | 28 | 10 | 120
81 s: 10 logs

    at 81 s
      10          1  Build Data Block: full; completes 10.2, deque +10.2
      10          2  Process Next Deque Block: proposed -> Block Add Request (10.2 on 10.1 28.1), not to 28 32 120
    at 91 s
      10          5  Vote Timer Expiration: approved; deque -10.2, chain +10.2 -> Commit Block (10.2 on 10.1 28.1), not to 28 32 120
      10          2  Process Next Deque Block: deque empty

100 s: partition 32 10 28 | 120
101 s: reconcile 32

    at 101 s
      32          7  Reconcile Begin: begun
      32          8  Reconcile Phase 1: asked -> Chain Contain Query (10.1 28.1), not to 120
      10 28       9  Receive Request Chain Contain from 32: yes -> Chain Contain Response (10.1 28.1: yes)
      32         10  Receive Phase 1 Response from 10 28: yes
    at 106 s
      32         11  Reconcile Phase 1 Timer Expiration: contained
      32         12  Reconcile Phase 2: asked -> Chain Hash Successor Query (10.1 28.1), not to 120
      10         13  Receive Request Next in Sequence from 32: successor -> Next in Sequence Response (10.1 28.1: 10.2)
      28         13  Receive Request Next in Sequence from 32: top of chain -> Next in Sequence Response (10.1 28.1: Is Top Of Chain)
      32         14  Receive Response Next in Sequence from 10: new candidate
      32         14  Receive Response Next in Sequence from 28: new candidate
    at 111 s
      32         15  Reconcile Phase 2 Timer Expiration: crashed by quirk

# It does not commit its own blocks any more.
130 s: 32 logs

    at 130 s
      32          1  Build Data Block: full; completes 32.1, deque +32.1
      32          2  Process Next Deque Block: reconcile in progress

150 s: heal
160 s: end

    chains
      inception 10.1  (120)
        28.1  (28 32)
          10.2  (10)
