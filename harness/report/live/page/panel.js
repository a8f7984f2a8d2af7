// Beside the map: what happened, in words, and what can be said of the six characteristics so far. All text is put in as
// text: names come from files that anybody may have written.

import { clock } from "./look.js";

const MOST = 250;
const KINDS = [
  ["network", "network", true], ["loss", "vehicles", true], ["reconcile", "reconciles", true],
  ["vote", "votes", true], ["commit", "commits", false],
];

export class Events {
  constructor(list, filters, seek) {
    this.list = list;
    this.seek = seek;
    list.addEventListener("keydown", (event) => this.step(event));
    this.shown = new Set(KINDS.filter(([, , on]) => on).map(([kind]) => kind));
    for (const [kind, label, on] of KINDS) {
      const button = element("button", label);
      button.type = "button";
      button.setAttribute("aria-pressed", on);
      button.addEventListener("click", () => {
        if (this.shown.has(kind)) this.shown.delete(kind); else this.shown.add(kind);
        button.setAttribute("aria-pressed", this.shown.has(kind));
        this.onFilter();
      });
      filters.append(button);
    }
    this.wipe();
  }

  wipe() { this.list.replaceChildren(); this.waiting = []; }

  // The arrow keys go from event to event.
  step(event) {
    const line = document.activeElement.closest("#events li");
    const next = { ArrowDown: line ? line.nextSibling : this.list.firstChild, ArrowUp: line?.previousSibling }[event.key];
    if (!(event.key in { ArrowDown: 0, ArrowUp: 0 })) return;
    event.preventDefault();
    next?.querySelector("button").focus();
  }

  // Takes a change; `swarm` is as it was right after it.
  take(change, swarm) {
    const told = inWords(change, swarm);
    if (told === null || !this.shown.has(told[0])) return;
    this.waiting.push([change[1], ...told]);
    if (this.waiting.length > MOST) this.waiting.shift();
  }

  // Puts what was taken on the page, the newest first.
  show() {
    if (!this.waiting.length) return;
    const lines = this.waiting.map(([t, kind, text]) => {
      const line = element("li"), time = element("button", clock(t));
      line.className = kind;
      time.type = "button";
      time.tabIndex = -1;
      time.title = "Go to this time";
      time.addEventListener("click", () => this.seek(t));
      line.append(time, element("i"), element("span", text));
      return line;
    });
    this.waiting = [];
    this.list.prepend(...lines.reverse());
    while (this.list.childElementCount > MOST) this.list.lastChild.remove();
  }
}

const PHASES = { "phase 1": "searches for the most common chain", "phase 2": "asks for the next block", "phase 3": "fetches a missing block", finalize: "restores its own blocks" };

function inWords(change, swarm) {
  const [kind, , ...rest] = change;
  if (kind === "s") {
    const [agent, doing, more] = rest;
    if (doing === "voting") return ["vote", `${agent} asks for votes on ${swarm.name(more)}`];
    if (doing === "voted") return ["vote", `${agent}'s vote: ${more}`];
    if (doing === "reconciling") return ["reconcile", `${agent} begins to reconcile: ${more}`];
    if (doing === "reconciled") return ["reconcile", `${agent} has reconciled, ${swarm.agents.get(agent).chain.length} blocks`];
    if (doing === "tie") return ["reconcile", `${agent}: ${more}`];
    return PHASES[doing] ? ["reconcile", `${agent}, ${doing}: ${PHASES[doing]}`] : null;
  }
  if (kind === "c") {
    const [agent, moves, , how] = rest;
    const came = moves.filter(([operation]) => operation === "chain+").map(([, key]) => swarm.name(key));
    return came.length && how ? ["commit", `${agent} commits ${came.slice(0, 5).join(", ")}${came.length > 5 ? " …" : ""}, ${how}`] : null;
  }
  if (kind === "n") {
    const [what, detail, agents, state, , parts, byHand] = rest;
    const words = `${what.replaceAll("_", " ")}: ${detail}${byHand ? " (by hand)" : ""}`;
    if (agents.length || state) return ["loss", words];
    if (what) return ["network", words];
    if (parts) return ["network", parts.length > 1 ? `in ${parts.length} parts: ${parts.map((part) => part.join(" ")).join(" | ")}` : "all are connected"];
    return null;
  }
  if (kind === "z") return ["loss", `${rest[0]} restarts`];
  if (kind === "x") return ["loss", `${rest[0]} ${AGAINST[rest[1]](swarm.name(rest[2]))}`];
  return null;
}

const AGAINST = {
  2: (block) => `is idle, but ${block}, which it completed, is not in its chain`,
  3: (block) => `holds ${block} twice`,
};
const NAMES = ["distributed", "idle implies committed", "single copy", "genuine", "all committed everywhere", "one uniform chain"];

export class Verdicts {
  constructor(title, list) {
    this.title = title;
    this.list = list;
    this.lines = new Map();
    this.before = "";
  }

  show(swarm, t, end, atTheEnd) {
    const judged = atTheEnd && end && end.judgements.length;
    const lines = judged
      ? end.judgements.map(([key, name, verdict, reason, kind]) => [key, name, `${verdict}: ${reason}`, [MARKS[kind], kind]])
      : soFar(swarm);
    const title = judged ? "Verdict" : `So far, at ${clock(t)}`;
    if (this.title.textContent !== title) this.title.textContent = title;
    const now = JSON.stringify(lines);
    if (now === this.before) return;
    this.before = now;
    this.list.replaceChildren(...lines.map(([, name, reason, [mark, kind]]) => {
      const line = element("li"), why = element("span", reason), sign = element("span", mark);
      line.className = kind;
      line.tabIndex = 0;
      sign.className = "mark";
      why.className = "reason";
      why.title = reason;
      line.append(sign, element("span", name), why);
      return line;
    }));
  }
}

const MARKS = { good: "✔", bad: "✘", unknown: "-" };

function soFar(swarm) {
  const blocks = swarm.blocks.size, chains = swarm.living.length, heads = swarm.heads.length;
  let everywhere = 0;
  for (const key of swarm.blocks.keys()) if ((swarm.inChains.get(key) ?? 0) >= chains) everywhere += 1;
  const against = (number) => {
    const first = swarm.against.find((each) => each.number === number);
    return first ? [`at ${clock(first.t)} ${first.agent} ${AGAINST[number](swarm.name(first.key))}`, ["✘", "bad"]] : ["no violation so far", ["·", "open"]];
  };
  const later = ["judged at the end", ["·", "open"]];
  const says = [
    later, against(2), against(3), later,
    [blocks ? `${everywhere} of ${blocks} blocks in every chain` : "no block yet", ["·", "open"]],
    [heads === 1 ? "one chain now" : `${heads} different chains now`, ["·", "open"]],
  ];
  return NAMES.map((name, at) => [at + 1, name, ...says[at]]);
}

export function element(name, text = "") {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}
