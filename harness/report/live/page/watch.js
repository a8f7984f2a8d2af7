// The page: it hears from the server what happens (story.js), and shows it at the second that somebody looks at. While a
// run goes on that is a moment ago, and afterwards any.

import { Chains } from "./chains.js";
import { Hand } from "./hand.js";
import { LINKS, clock, colour, family, percent, prepared, shape, whenColoursChange } from "./look.js";
import { PULSE_WALL_S, SwarmMap } from "./map.js";
import { Events, Verdicts, element } from "./panel.js";
import { Playhead, Story } from "./story.js";
import { Timeline } from "./timeline.js";

const SPEEDS = [0.25, 0.5, 1, 2, 5, 10, 20, 50, 100, 200];
const BEHIND_WALL_S = 0.5; // so much later than the run a live page is: by then everybody has told what they did
const MOST_PULSES = 120;
const KNOWN_AFTER_S = 10; // by so many later mission seconds a page judges whether a receiver lost a message
const FRAME_MS = 1000 / 30;

const $ = (id) => document.getElementById(id);
const story = new Story();
let playhead = null, map, chains, timeline, events, verdicts;
let playing = true, following = true, speed = 20, dragged = false;
let pulses = [], told = 0, before = 0, changed = true, lastDrawn = 0;
let arrivals = [], hand = null, socket = null;

function begin() {
  const { run } = story;
  document.title = `${run.name} · UCP swarm`;
  $("name").textContent = run.name;
  const facts = [`${run.roster.length} vehicles`, run.backend, run.seed === null ? null : `seed ${run.seed}`, run.directory];
  $("about").textContent = facts.filter(Boolean).join(" · ");
  playhead = new Playhead(story);
  map = new SwarmMap($("map"), story);
  chains = new Chains($("chains"), story);
  timeline = new Timeline($("timeline"), story, seek);
  events = new Events($("events"), $("filters"), seek);
  events.onFilter = () => { playhead.reset(); events.wipe(); move(time); };
  verdicts = new Verdicts($("judged-title"), $("verdicts"));
  speed = d3.least(SPEEDS, (each) => Math.abs(each - (run.live ? 1 : 20)));
  $("speed").value = speed;
  following = run.live;
  if (run.live) {
    hand = new Hand($("hand"), (asked) => socket.send(JSON.stringify(asked)), () => { changed = true; });
    hand.roster = run.roster;
    hand.befall(run);
    map.chosen = hand.chosen;
    $("map").addEventListener("click", (event) => choose(map.nearest(event.offsetX, event.offsetY)));
    $("choose-hint").hidden = false;
    if (story.hand) hand.take(story.hand);
    $("hand").hidden = false;
  }
  $("live").hidden = !run.live;
  drawLegend();
}

let time = 0;
const lastSecond = () => Math.max(story.until, 0);
// The right end of the timeline: of a run that goes on, when it is to end.
const horizon = () => story.end ? lastSecond() : Math.max(lastSecond(), story.run.duration_s ?? 0);

function seek(t) {
  following = false;
  time = Math.max(0, Math.min(t, lastSecond()));
  pulses = [];
  told = time;
  changed = true;
}

function move(t) {
  const again = playhead.seek(t, (change, swarm) => events.take(change, swarm));
  if (again) { // what was told before is told anew
    events.list.replaceChildren();
  }
  events.show();
}

// How fast mission time goes for a run that goes on, by what came in the last seconds.
function rate(now) {
  while (arrivals.length > 2 && arrivals[0][0] < now - 3000) arrivals.shift();
  if (arrivals.length < 2) return story.run.speedup ?? 1;
  const [w0, t0] = arrivals[0], [w1, t1] = arrivals.at(-1);
  return w1 > w0 ? (t1 - t0) / (w1 - w0) * 1000 : 0;
}

function frame(now) {
  requestAnimationFrame(frame);
  if (playhead === null || now - lastDrawn < FRAME_MS - 2) return;
  const passed = Math.min((now - (lastDrawn || now)) / 1000, 0.5);
  lastDrawn = now;
  const live = story.run.live && !story.end;
  if (following && live) {
    const behind = rate(now) * BEHIND_WALL_S;
    const target = Math.max(0, lastSecond() - behind);
    const next = time + passed * rate(now);
    // Evenly, but never far from where it should be.
    time = Math.abs(next - target) > 2 * behind + 1 ? target : Math.max(time, Math.min(next + 0.1 * (target - next), lastSecond()));
    changed = true;
  } else if (following && story.end) {
    time = lastSecond();
    following = false;
    playing = false;
    changed = true;
  } else if (playing) {
    const next = Math.min(time + passed * speed, lastSecond());
    changed ||= next !== time;
    time = next;
    if (time >= lastSecond() && story.end) playing = false;
  }
  if (story.firstChanged < playhead.next) changed = true;
  gather(passed);
  if (!changed && !pulses.length && !map.pointer && map.steady) return;
  changed = false;
  move(time);
  show();
}

// What was said since the last frame lights up, and fades.
function gather(passed) {
  for (const pulse of pulses) pulse.age += passed;
  pulses = pulses.filter((pulse) => pulse.age < PULSE_WALL_S);
  if (time < told) told = time;
  if (time === told) return;
  const { run } = story;
  const recent = [];
  for (const { message: [, , sender, message], all, lost } of story.fates(told, time, time + KNOWN_AFTER_S)) {
    const among = (mask) => run.roster.filter((_, index) => mask >> BigInt(index) & 1n);
    recent.push({ age: 0, sender, message, heard: among(all), lost: run.all_heard ? among(lost) : [] });
    if (recent.length === MOST_PULSES) break;
  }
  pulses.push(...recent.reverse());
  if (pulses.length > MOST_PULSES) pulses = pulses.slice(-MOST_PULSES);
  told = time;
}

function show() {
  const { swarm } = playhead, end = horizon(), live = story.run.live && !story.end;
  map.draw(playhead, pulses);
  timeline.draw(time, end, live);
  const slow = performance.now();
  if (slow - before > 90 || !playing) {
    before = slow;
    chains.draw(swarm);
    const heads = swarm.heads, uniform = heads.length <= 1;
    const few = swarm.run.roster.length <= 12;
    const groups = heads.map((same) => few ? same.join(" ") : String(same.length)).join(" | ");
    $("heads").textContent = uniform ? "all the same" : `${heads.length} different${few ? "" : ", held by"}: ${groups}`;
    $("heads").classList.toggle("apart", !uniform);
    verdicts.show(swarm, time, story.end, time >= lastSecond() - 1e-6);
    const drops = swarm.drops ? ` · ${swarm.drops} dropped` : "";
    $("counts").textContent = `${swarm.blocks.size} blocks · ${swarm.votes} votes · ${swarm.reconciles} reconciles${drops}${shareLost()}`;
    const parts = swarm.parts.length > 1 ? `in ${swarm.parts.length} parts: ${swarm.parts.map(listed).join(" | ")}` : "";
    const conditions = few ? swarm.conditions : swarm.conditions.replace(/, partition .*/, "");
    $("clock").replaceChildren(clock(time), element("small", [conditions, parts].filter(Boolean).join(" · ")));
  } else changed = true;
  $("slider").max = end;
  if (!dragged) $("slider").value = time;
  $("slider").setAttribute("aria-valuetext", clock(time));
  $("at").textContent = `${clock(time)} / ${clock(end)}`;
  $("play").textContent = playing && !(following && live) ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  $("speeds").hidden = following && live;
  $("live").classList.toggle("on", following && live);
}

const listed = (ids) => ids.length > 6 ? `${ids.slice(0, 5).join(" ")} … (${ids.length})` : ids.join(" ");

function shareLost() {
  const share = story.run.all_heard ? story.shareLost(time - 60, time) : null;
  return share === null ? "" : ` · ${percent(share)} lost in the last minute`;
}

function showStatus() {
  const { end, run } = story, status = $("status");
  status.classList.remove("good", "bad", "now");
  if (!end) {
    const stage = story.hand?.paused ? "held" : story.hand?.stage ?? "";
    const [late, leavesOut] = story.late;
    const behind = late || leavesOut ? `${late} s behind the run${leavesOut ? ", without messages" : ""}` : "";
    const more = [stage !== "mission" ? stage : "", behind].filter(Boolean).join(", ");
    status.textContent = run?.live ? `● live${more ? `: ${more}` : ""}` : "reading";
    if (run?.live) status.classList.add("now");
    return;
  }
  $("live").hidden = true;
  $("hand").hidden = true;
  const bad = end.judgements.filter(([, , , , kind]) => kind === "bad");
  const open = end.judgements.filter(([, , , , kind]) => kind === "unknown");
  if (!end.judgements.length) status.textContent = end.outcome === "running" ? "did not end normally" : end.outcome;
  else if (bad.length) { status.textContent = bad.map(([, name, verdict]) => `${name}: ${verdict}`).join("; "); if (!bad.every(([, , verdict]) => verdict.endsWith("as expected"))) status.classList.add("bad"); }
  else if (open.length) status.textContent = `not judged: ${open.map(([, name]) => name).join(", ")}`;
  else { status.textContent = "all good"; status.classList.add("good"); }
  $("report").hidden = !end.report;
  complain([end.outcome !== "completed" && end.detail ? end.detail : "", ...story.notes].filter(Boolean));
}

function complain(sentences) {
  $("trouble").hidden = !sentences.length;
  $("trouble").textContent = sentences.slice(0, 4).join("; ");
}

function drawLegend() {
  const { run } = story, entries = [];
  const entry = (paint, says) => {
    const line = element("li"), sample = document.createElement("canvas");
    line.append(sample, says);
    entries.push([line, sample, paint]);
  };
  LINKS.forEach((link, grade) => entry((context) => {
    context.strokeStyle = colour(link.colour);
    context.lineWidth = link.width * 1.3;
    context.setLineDash(link.dash);
    context.beginPath(); context.moveTo(0, 7); context.lineTo(26, 7); context.stroke();
  }, run.link_qualities[grade]));
  for (const [kind, says] of [["vote", "vote"], ["commit", "commit"], ["reconcile", "reconcile"]]) entry((context) => {
    context.strokeStyle = colour(kind);
    context.lineWidth = 2.5;
    context.beginPath(); context.moveTo(3, 7); context.lineTo(23, 7); context.stroke();
  }, says);
  if (run.all_heard) entry((context) => {
    context.strokeStyle = colour("lost");
    context.lineWidth = 2;
    context.beginPath(); context.moveTo(9, 3); context.lineTo(17, 11); context.moveTo(17, 3); context.lineTo(9, 11); context.stroke();
  }, "lost");
  const types = [...new Set(run.types)];
  if (types.length > 1) for (const type of types) entry((context) => {
    context.translate(13, 7);
    context.fillStyle = colour("quiet");
    context.beginPath(); d3.symbol(shape(type), 70).context(context)(); context.fill();
  }, type);
  $("legend").replaceChildren(...entries.map(([line]) => line));
  for (const [, sample, paint] of entries) paint(prepared(sample).context);
}

function controls() {
  $("speed").append(...SPEEDS.map((each) => { const option = element("option", `${each}×`); option.value = each; return option; }));
  $("speed").addEventListener("change", () => { speed = +$("speed").value; following = false; playing = true; });
  $("play").addEventListener("click", toggle);
  $("live").addEventListener("click", () => { following = true; playing = true; });
  $("slider").addEventListener("input", () => { dragged = true; seek(+$("slider").value); });
  $("slider").addEventListener("change", () => { dragged = false; });
  $("zoom-in").addEventListener("click", () => { map?.scaleBy(1.5); changed = true; });
  $("zoom-out").addEventListener("click", () => { map?.scaleBy(1 / 1.5); changed = true; });
  $("zoom-fit").addEventListener("click", () => { map?.fit(); changed = true; });
  addEventListener("keydown", (event) => {
    if (event.target.matches("input, select, button") && event.key !== " ") return;
    if (event.target.matches("button, select") || playhead === null || event.ctrlKey || event.metaKey || event.altKey) return;
    const press = event.shiftKey && MOVES[event.key] ? () => map.moveBy(...MOVES[event.key]) : KEYS[event.key];
    if (!press || event.defaultPrevented) return;
    press();
    changed = true;
    event.preventDefault();
  });
  addEventListener("resize", () => { changed = true; });
  whenColoursChange(() => { changed = true; if (story.run) drawLegend(); });
  for (const name of ["wheel", "pointermove", "pointerleave"]) $("map").addEventListener(name, () => { changed = true; }, { passive: true });
}

const MOVES = { ArrowLeft: [-60, 0], ArrowRight: [60, 0], ArrowUp: [0, -60], ArrowDown: [0, 60] };
const next = (by) => { $("vehicle").textContent = map.focusNext(by, playhead.swarm); };
const KEYS = {
  " ": () => toggle(),
  ArrowLeft: () => seek(time - 10), ArrowRight: () => seek(time + 10), Home: () => seek(-Infinity), End: () => seek(Infinity),
  "+": () => map.scaleBy(1.5), "=": () => map.scaleBy(1.5), "-": () => map.scaleBy(1 / 1.5), 0: () => map.fit(),
  n: () => next(1), p: () => next(-1), Enter: () => choose(map.focused),
};

function choose(id) {
  if (id === null || !hand || story.end) return;
  hand.choose(id);
  $("vehicle").textContent = `vehicle ${id} ${hand.chosen.has(id) ? "chosen" : "not chosen"}`;
}

function toggle() {
  if (following && story.run.live && !story.end) { following = false; playing = false; }
  else if (playing) playing = false;
  else {
    playing = true;
    if (time >= lastSecond() - 1e-6 && story.end) seek(0);
  }
  changed = true;
}

function connect() {
  const address = new URL("live", location.href);
  address.protocol = "ws:";
  socket = new WebSocket(address);
  socket.addEventListener("message", ({ data }) => {
    const had = story.run, ended = story.end;
    const stood = story.hand, late = story.late;
    for (const line of data.split("\n")) if (line) {
      const change = JSON.parse(line);
      if (change[0] === "answer") hand?.answered(change[1], change[2]); else story.take(change);
    }
    if (!had && story.run) begin();
    arrivals.push([performance.now(), story.until]);
    changed = true;
    if (story.hand !== stood && hand) hand.take(story.hand);
    if (story.run && (!had || story.end !== ended || story.hand !== stood || story.late !== late)) showStatus();
    if (story.notes.length && !story.end) complain(story.notes);
  });
  socket.addEventListener("close", () => {
    if (!story.end) complain(["The server has ended. The page shows the records received before."]);
    changed = true;
  });
}

controls();
connect();
requestAnimationFrame(frame);

// For tests: what the page knows and where it stands.
window.watch = { story, get time() { return time; }, get playhead() { return playhead; }, get hand() { return hand; }, seek, get playing() { return playing; } };
