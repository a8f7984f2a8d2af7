// What the server tells, kept in order of time, and the swarm as it was at any second of it.

const MOST_COUNTED = 2000; // messages, in a figure
const bits = (mask) => mask.toString(2).split("1").length - 1;

const TELLS_STATE = new Set(["n", "b", "c", "z", "s", "x", "d"]);

export class Story {
  constructor() {
    this.run = null;
    this.end = null;
    this.hand = null;
    this.notes = [];
    this.until = 0;
    this.late = [0, false]; // seconds of wall time, and whether messages are left out
    this.gaps = [];
    this.log = [];
    this.messages = [];
    this.tracks = new Map();
    this.firstChanged = Infinity;
  }

  // One line of what the server tells.
  take(change) {
    const [kind, second] = change;
    if (kind === "run") {
      this.run = second;
      this.index = new Map(second.roster.map((agent, index) => [agent, index]));
      this.ahead = new Swarm(second);
      this.ahead.history = new History(second);
    } else if (kind === "end") this.end = second;
    else if (kind === "hand") this.hand = second;
    else if (kind === "note") this.notes.push(second);
    else if (this.run === null) return;
    else if (kind === "late") this.late = change.slice(1);
    else if (kind === "gap") this.gaps.push(change);
    else if (kind === "all") this.run.all_heard = true;
    else if (kind === "t") this.until = Math.max(this.until, second);
    else if (kind === "p") this.place(second, change[2]);
    else if (kind === "m") insert(this.messages, change);
    else if (kind === "h") this.addReceivers(second, ...change.slice(2));
    else if (TELLS_STATE.has(kind)) {
      this.firstChanged = Math.min(this.firstChanged, insert(this.log, change));
      this.ahead.apply(change);
    }
  }

  place(t, places) {
    for (const [agent, [north, east, up]] of Object.entries(places)) {
      let track = this.tracks.get(+agent);
      if (!track) this.tracks.set(+agent, (track = []));
      insert(track, [0, t, north, east, up], 1);
    }
  }

  // Where a vehicle was: straight between two places; and in which direction it went, in radians from north, or null.
  at(agent, t) {
    const track = this.tracks.get(agent);
    if (!track) return null;
    const after = firstAfter(track, t);
    const b = track[Math.max(after - 1, 0)], a = track[Math.min(after, track.length - 1)];
    const share = a[1] > b[1] ? Math.min(Math.max((t - b[1]) / (a[1] - b[1]), 0), 1) : 0;
    const north = b[2] + share * (a[2] - b[2]), east = b[3] + share * (a[3] - b[3]), up = b[4] + share * (a[4] - b[4]);
    const back = track[Math.max(after - 2, 0)];
    const dn = a[2] - back[2], de = a[3] - back[3];
    return { north, east, up, course: Math.hypot(dn, de) > 0.5 ? Math.atan2(de, dn) : null };
  }

  // A receiver on a busy machine records a message late.
  addReceivers(t, agent, mask, sequence) {
    for (let at = firstAfter(this.messages, t) - 1; at >= 0 && this.messages[at][1] === t; at -= 1) {
      const message = this.messages[at];
      if (message[2] === agent && message[6] === sequence) message[5] = mask;
    }
  }

  // The messages after one second, up to and with another, the newest first, each with masks of the receivers that got
  // it and that lost it. A receiver handles messages in order. So it lost a message if it could have received it, and
  // has received a later one, up to the second `known`. What a receiver has done with the newest messages is not known.
  // Receptions in a gap are not known either, so each gap begins anew.
  *fates(from, to, known = to) {
    const { messages } = this, { history } = this.ahead;
    let later = 0n, gap = firstAfter(this.gaps, known) - 1;
    for (let at = firstAfter(messages, known) - 1; at >= 0 && messages[at][1] > from; at -= 1) {
      const [, t, sender, , , mask] = messages[at], heard = BigInt(`0x${mask}`);
      for (; gap >= 0 && t <= this.gaps[gap][1]; gap -= 1) later = 0n;
      if (t <= to) yield { message: messages[at], heard: heard & later, lost: later & ~heard & history.reach(sender, t), all: heard };
      later |= heard;
    }
  }

  // The share of receptions that were lost between two seconds; null if nothing is known.
  shareLost(from, to) {
    let heard = 0, lost = 0, left = MOST_COUNTED;
    for (const fate of this.fates(from, to)) {
      heard += bits(fate.heard);
      lost += bits(fate.lost);
      if (!(left -= 1)) break;
    }
    return heard + lost ? lost / (heard + lost) : null;
  }
}

// The first whose time is later.
export function firstAfter(list, t) {
  let low = 0, high = list.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle][1] <= t) low = middle + 1; else high = middle;
  }
  return low;
}

function insert(list, item) {
  let at = list.length;
  if (at && list[at - 1][1] > item[1]) {
    at = firstAfter(list, item[1]);
    list.splice(at, 0, item);
  } else list.push(item);
  return at;
}

const newAgent = () => ({
  chain: [], deque: [], stack: [], top: "", doing: "idle", more: "", since: 0, state: "up", committed: -Infinity,
});

// All agents and links at one moment; `apply` takes it to the next.
export class Swarm {
  constructor(run) {
    this.run = run;
    this.agents = new Map(run.roster.map((agent) => [agent, newAgent()]));
    this.blocks = new Map();
    this.inChains = new Map();
    this.links = new Map();
    this.parts = [];
    this.conditions = "";
    this.against = [];
    this.reconciles = this.votes = this.drops = 0;
    this.history = null;
  }

  apply(change) {
    const [kind, t, ...rest] = change;
    this[kind]?.(t, ...rest);
    this.history?.take(change, this);
  }

  b(t, key, agent, ordinal) { if (!this.blocks.has(key)) this.blocks.set(key, { agent, ordinal, t }); }

  c(t, id, moves, top, how) {
    const agent = this.agents.get(id);
    for (const [operation, key] of moves) {
      const place = agent[operation.slice(0, -1)];
      if (!Array.isArray(place)) continue;
      const inChain = operation.startsWith("chain");
      if (operation.endsWith("+")) {
        if (operation === "deque+" || inChain || operation === "stack+") place.push(key);
        if (inChain) { this.inChains.set(key, (this.inChains.get(key) ?? 0) + 1); agent.committed = t; }
      } else {
        const at = operation === "deque-" ? place.indexOf(key) : place.lastIndexOf(key);
        if (at < 0) continue;
        place.splice(at, 1);
        if (inChain) this.inChains.set(key, this.inChains.get(key) - 1);
      }
    }
    agent.top = top;
  }

  z(t, id) {
    const old = this.agents.get(id);
    for (const key of old.chain) this.inChains.set(key, this.inChains.get(key) - 1);
    this.agents.set(id, newAgent());
  }

  s(t, id, doing, more) {
    const agent = this.agents.get(id);
    if (doing === "tie" || (doing === "voted" && this.reconcilingNow(agent))) return;
    if (doing === "reconciling") this.reconciles += 1;
    if (doing === "voting") this.votes += 1;
    agent.doing = doing === "voted" || doing === "reconciled" ? "idle" : doing;
    agent.more = more;
    agent.since = t;
  }

  n(t, what, detail, agents, state, pairs, parts) {
    for (const [low, high, there, back] of pairs) this.links.set(`${low}-${high}`, [low, high, there, back]);
    if (parts) this.parts = parts;
    if (state === "down" || state === "gone" || state === "still") for (const id of agents) this.agents.get(id).state = state;
    else if (state) for (const id of agents) this.agents.get(id).state = "up";
    if (!agents.length && what) this.conditions = detail;
  }

  x(t, agent, number, key) { this.against.push({ t, agent, number, key }); }

  d() { this.drops += 1; }

  reconcilingNow(agent) { return agent.doing.startsWith("phase") || agent.doing === "finalize" || agent.doing === "reconciling"; }

  get living() { return this.run.roster.filter((id) => !["down", "gone"].includes(this.agents.get(id).state)); }

  // Vehicles by the top of their chains, the most first.
  get heads() {
    const heads = new Map();
    for (const id of this.living) {
      const { top } = this.agents.get(id);
      if (!heads.has(top)) heads.set(top, []);
      heads.get(top).push(id);
    }
    return [...heads.values()].sort((a, b) => b.length - a.length || a[0] - b[0]);
  }

  name(key) {
    const block = this.blocks.get(key);
    return block ? `${block.agent}.${block.ordinal}` : key.slice(0, 8);
  }
}

// What a timeline draws, of all that is known: spans of votes and reconciles, how many chains there were, marks.
export class History {
  constructor(run) {
    this.spans = [];
    this.open = new Map();
    this.heads = [[0, 0, 1]];
    this.parts = [[0, 0, 1]];
    this.marks = [];
    this.gone = [];
    this.version = 0;
    this.bit = new Map(run.roster.map((agent, index) => [agent, 1n << BigInt(index)]));
    this.linked = new Map(run.roster.map((agent) => [agent, [[0, 0, 0n]]]));
    this.up = [[0, 0, [...this.bit.values()].reduce((all, bit) => all | bit, 0n)]];
  }

  // The receivers that a message of that agent and second could reach, as a mask.
  reach(agent, t) { return at(this.linked.get(agent), t) & at(this.up, t); }

  link(t, from, to, loss) {
    const steps = this.linked.get(from), before = steps.at(-1)[2], bit = this.bit.get(to);
    push(steps, t, loss < 1 ? before | bit : before & ~bit);
  }

  take([kind, t, ...rest], swarm) {
    this.version += 1;
    if (kind === "s") {
      const [agent, doing, more] = rest;
      if (doing === "voting") this.begin(agent, t, "vote");
      else if (doing === "voted") this.close(agent, t, "vote", more);
      else if (doing === "reconciling") this.begin(agent, t, "reconcile");
      else if (doing === "reconciled") this.close(agent, t, "reconcile", "done");
    } else if (kind === "c" || kind === "z") {
      if (kind === "z") { this.close(rest[0], t, "vote", "cut short"); this.close(rest[0], t, "reconcile", "cut short"); }
      this.countHeads(t, swarm);
    } else if (kind === "n") {
      const [what, detail, agents, state, pairs, parts] = rest;
      for (const [low, high, there, back] of pairs) { this.link(t, low, high, there); this.link(t, high, low, back); }
      if (parts) push(this.parts, t, parts.length);
      if (state) {
        let up = this.up.at(-1)[2];
        for (const agent of agents) up = swarm.agents.get(agent).state === "up" ? up | this.bit.get(agent) : up & ~this.bit.get(agent);
        push(this.up, t, up);
      }
      if (state === "down" || state === "gone") for (const agent of agents) {
        this.close(agent, t, "vote", "cut short"); this.close(agent, t, "reconcile", "cut short");
        this.begin(agent, t, "gone");
      }
      if (state === "back") for (const agent of agents) this.close(agent, t, "gone", "");
      if (what && what !== "start") this.marks.push([0, t, what, detail]);
      if (state) this.countHeads(t, swarm);
    }
  }

  countHeads(t, swarm) { push(this.heads, t, swarm.heads.length); }

  begin(agent, t, what) {
    const span = { agent, what, from: t, to: null, how: "" };
    this.open.set(`${agent} ${what}`, span);
    this.spans.push(span);
  }

  close(agent, t, what, how) {
    const span = this.open.get(`${agent} ${what}`);
    if (!span) return;
    span.to = Math.max(t, span.from);
    span.how = how;
    this.open.delete(`${agent} ${what}`);
  }
}

const at = (steps, t) => steps[Math.max(0, firstAfter(steps, t) - 1)][2];

function push(steps, t, value) {
  const last = steps[steps.length - 1];
  if (last[2] === value) return;
  if (last[1] >= t) last[2] = value; else steps.push([0, t, value]);
}

// The swarm at the second that somebody looks at: forward step by step, backward from the beginning again.
export class Playhead {
  constructor(story) {
    this.story = story;
    this.reset();
  }

  reset() {
    this.swarm = new Swarm(this.story.run);
    this.next = 0;
    this.t = 0;
  }

  // Moves there, and tells `passed` of each change on the way; true if it went back to the beginning for it.
  seek(t, passed) {
    const { story } = this;
    const again = t < this.t || story.firstChanged < this.next;
    if (again) this.reset();
    story.firstChanged = Infinity;
    this.t = t;
    while (this.next < story.log.length && story.log[this.next][1] <= t) {
      const change = story.log[this.next++];
      this.swarm.apply(change);
      passed?.(change, this.swarm);
    }
    return again;
  }
}
