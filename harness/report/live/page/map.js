// The map: where the vehicles are, what the links between them lose, what is said over them, and who is cut off.
// Vehicles without places stand in a ring.

import { LINKS, colour, family, font, partColour, prepared, shape } from "./look.js";

const TRAIL_S = 60;
const PULSE_WALL_S = 0.7;
const MARGIN = 56, LEGEND = 26;

export class SwarmMap {
  constructor(canvas, story) {
    this.canvas = canvas;
    this.story = story;
    this.transform = d3.zoomIdentity;
    this.touched = false;
    this.zoom = d3.zoom().scaleExtent([0.2, 60]).on("zoom", (event) => {
      this.transform = event.transform;
      if (event.sourceEvent) this.touched = true;
    });
    this.selection = d3.select(canvas).call(this.zoom);
    this.chosen = new Set();
    canvas.addEventListener("pointermove", (event) => { this.pointer = [event.offsetX, event.offsetY]; });
    canvas.addEventListener("pointerleave", () => { this.pointer = null; });
    this.placed = new Map();
    this.base = null;
    this.focused = null; // the vehicle that the keyboard is at
  }

  moveBy(right, down) {
    this.touched = true;
    this.selection.call(this.zoom.translateBy, -right / this.transform.k, -down / this.transform.k);
  }

  // The keyboard goes to the next vehicle, or with -1 to the one before. Returns what the map tells about it.
  focusNext(by, swarm) {
    const { roster } = this.story.run, from = roster.indexOf(this.focused);
    this.pointer = null;
    this.focused = roster[from < 0 ? 0 : (from + by + roster.length) % roster.length];
    return this.lines(this.focused, swarm).join("; ");
  }

  scaleBy(factor) { this.touched = true; this.selection.transition().duration(150).call(this.zoom.scaleBy, factor); }

  fit() { this.touched = false; this.selection.transition().duration(200).call(this.zoom.transform, d3.zoomIdentity); }

  // From metres east and north to the window: the swarm, with where it was in the last minute, and evenly after it.
  fitted(t, width, height) {
    let west = Infinity, south = Infinity, east = -Infinity, north = -Infinity;
    for (const id of this.story.tracks.keys()) for (const at of [t, t - TRAIL_S / 2, t - TRAIL_S].map((then) => this.story.at(id, then))) {
      west = Math.min(west, at.east); east = Math.max(east, at.east);
      south = Math.min(south, at.north); north = Math.max(north, at.north);
    }
    if (west > east) [west, south, east, north] = [-1, -1, 1, 1];
    const wide = Math.max(east - west, 30), tall = Math.max(north - south, 30);
    const scale = Math.min((width - 2 * MARGIN) / wide, (height - 2 * MARGIN - LEGEND) / tall);
    const target = { scale, x: width / 2 - scale * (west + east) / 2, y: (height - LEGEND) / 2 + scale * (south + north) / 2 };
    const base = this.base;
    if (!base || base.width !== width || base.height !== height) this.base = { ...target, width, height };
    else if (!this.touched) for (const key of ["scale", "x", "y"]) base[key] += 0.08 * (target[key] - base[key]);
    return this.touched || Math.abs(target.scale / this.base.scale - 1) < 0.005 && Math.abs(target.x - this.base.x) + Math.abs(target.y - this.base.y) < 1;
  }

  place(id, index, count, t, width, height) {
    const at = this.story.at(id, t);
    let x, y, course = null, up = null;
    if (at) {
      x = this.base.x + this.base.scale * at.east;
      y = this.base.y - this.base.scale * at.north;
      ({ course, up } = at);
    } else {
      const radius = Math.min(width, height) / 2 - MARGIN;
      const angle = 2 * Math.PI * index / count - Math.PI / 2;
      x = width / 2 + radius * Math.cos(angle);
      y = height / 2 + radius * Math.sin(angle);
    }
    const [px, py] = this.transform.apply([x, y]);
    return { x: px, y: py, course, up };
  }

  draw(playhead, pulses) {
    const { context, width, height } = prepared(this.canvas);
    const { swarm, t } = playhead, { run } = this.story;
    const anywhere = this.story.tracks.size > 0;
    this.steady = this.fitted(t, width, height);
    this.placed = new Map(run.roster.map((id, index) => [id, this.place(id, index, run.roster.length, t, width, height)]));
    this.radius = Math.max(6.5, Math.min(13, 34 / Math.sqrt(run.roster.length) + 4));
    if (anywhere) this.grid(context, width, height);
    this.hulls(context, swarm);
    if (anywhere) this.trails(context, run, swarm, t);
    this.links(context, swarm);
    this.pulses(context, swarm, pulses);
    this.vehicles(context, run, swarm);
    if (anywhere) this.bar(context, width, height);
    this.told(context, swarm, width, height);
  }

  metresPerPixel() { return 1 / (this.base.scale * this.transform.k); }

  grid(context, width, height) {
    const step = niceStep(110 * this.metresPerPixel()) / this.metresPerPixel();
    const [x0, y0] = this.transform.apply([this.base.x, this.base.y]);
    context.beginPath();
    for (let x = x0 % step; x < width; x += step) { context.moveTo(Math.round(x) + 0.5, 0); context.lineTo(Math.round(x) + 0.5, height); }
    for (let y = y0 % step; y < height; y += step) { context.moveTo(0, Math.round(y) + 0.5); context.lineTo(width, Math.round(y) + 0.5); }
    context.strokeStyle = colour("rule");
    context.globalAlpha = 0.45;
    context.lineWidth = 1;
    context.stroke();
    context.globalAlpha = 1;
  }

  bar(context, width, height) {
    const metres = niceStep(110 * this.metresPerPixel()), length = metres / this.metresPerPixel();
    const x = width - 18 - length, y = height - 16;
    context.strokeStyle = context.fillStyle = colour("quiet");
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x, y - 4); context.lineTo(x, y); context.lineTo(x + length, y); context.lineTo(x + length, y - 4);
    context.stroke();
    context.textAlign = "center";
    context.font = font(11);
    context.fillText(metres >= 1000 ? `${metres / 1000} km` : `${metres} m`, x + length / 2, y - 7);
  }

  // A partition: each part on a ground of its own.
  hulls(context, swarm) {
    if (swarm.parts.length < 2) return;
    swarm.parts.forEach((part, number) => {
      const points = part.filter((id) => this.placed.has(id)).flatMap((id) => around(this.placed.get(id), this.radius + 13));
      const hull = d3.polygonHull(points);
      if (!hull) return;
      const of = part.length === 1 ? "alone" : partColour(number);
      context.beginPath();
      d3.line().curve(d3.curveCatmullRomClosed.alpha(1)).context(context)(hull);
      context.globalAlpha = 0.09;
      context.fillStyle = colour(of);
      context.fill();
      context.globalAlpha = 0.8;
      context.strokeStyle = colour(of);
      context.lineWidth = 1.25;
      context.setLineDash([2, 4]);
      context.stroke();
      context.setLineDash([]);
      context.globalAlpha = 1;
    });
  }

  trails(context, run, swarm, t) {
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    for (const [index, id] of run.roster.entries()) {
      const track = this.story.tracks.get(id);
      if (!track || swarm.agents.get(id).state === "gone") continue;
      context.strokeStyle = run.inks[index][1];
      const step = TRAIL_S / 20;
      for (let back = TRAIL_S; back > 0; back -= step) {
        if (t - back < track[0][1]) continue;
        const from = this.point(this.story.at(id, t - back)), to = this.point(this.story.at(id, t - back + step));
        context.globalAlpha = 0.55 * (1 - back / TRAIL_S) + 0.03;
        context.beginPath();
        context.moveTo(...from); context.lineTo(...to);
        context.stroke();
      }
    }
    context.globalAlpha = 1;
  }

  point(at) { return this.transform.apply([this.base.x + this.base.scale * at.east, this.base.y - this.base.scale * at.north]); }

  // Those that lose most below: what can be relied on is seen last, and so first.
  links(context, swarm) {
    const partOf = new Map();
    if (swarm.parts.length > 1) swarm.parts.forEach((part, number) => { for (const id of part) partOf.set(id, number); });
    const paths = new Map();
    for (const [low, high, there, back] of swarm.links.values()) {
      const grade = swarm.run.quality_limits.filter((limit) => (there + back) / 2 >= limit).length;
      const [a, b] = [swarm.agents.get(low), swarm.agents.get(high)];
      if (grade > 3 || a.state === "gone" || b.state === "gone") continue;
      const of = grade < 2 && partOf.has(low) ? partColour(partOf.get(low)) : LINKS[grade].colour;
      const key = `${3 - grade} ${of}`;
      if (!paths.has(key)) paths.set(key, { grade, of, path: new Path2D() });
      const { path } = paths.get(key), from = this.placed.get(low), to = this.placed.get(high);
      path.moveTo(from.x, from.y); path.lineTo(to.x, to.y);
    }
    const crowd = Math.min(1, 14 / swarm.run.roster.length + 0.12);
    for (const key of [...paths.keys()].sort()) {
      const { grade, of, path } = paths.get(key), link = LINKS[grade];
      context.strokeStyle = colour(of);
      context.lineWidth = link.width;
      context.globalAlpha = link.alpha * (grade < 2 ? crowd : Math.min(1, 2 * crowd));
      context.setLineDash(link.dash);
      context.stroke(path);
    }
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  // What was said a moment ago: a ring round the speaker, a spark to whoever heard it, and a cross where it was lost.
  pulses(context, swarm, pulses) {
    const few = swarm.run.roster.length <= 20;
    for (const { age, sender, message, heard, lost } of pulses) {
      const from = this.placed.get(sender), share = age / PULSE_WALL_S;
      if (!from || share >= 1) continue;
      const fade = 1 - share;
      context.strokeStyle = context.fillStyle = colour(family(message));
      context.lineWidth = 1.5;
      context.globalAlpha = 0.7 * fade;
      context.beginPath();
      context.arc(from.x, from.y, this.radius + 4 + 16 * share, 0, 2 * Math.PI);
      context.stroke();
      context.lineWidth = few ? 2 : 1.2;
      const head = Math.min(1, share * 1.6), tail = Math.max(0, head - 0.3);
      context.globalAlpha = (few ? 0.95 : 0.6) * fade;
      context.beginPath();
      for (const id of heard) {
        const to = this.placed.get(id);
        if (!to) continue;
        context.moveTo(from.x + tail * (to.x - from.x), from.y + tail * (to.y - from.y));
        context.lineTo(from.x + head * (to.x - from.x), from.y + head * (to.y - from.y));
      }
      context.stroke();
      context.strokeStyle = colour("lost");
      context.lineWidth = few ? 1.75 : 1;
      context.globalAlpha = (few ? 1 : 0.7) * fade;
      context.beginPath();
      for (const id of lost) {
        const to = this.placed.get(id);
        if (!to) continue;
        const away = Math.hypot(to.x - from.x, to.y - from.y) || 1;
        const at = Math.min(head, Math.max(0.5, 1 - (this.radius + 16) / away));
        const x = from.x + at * (to.x - from.x), y = from.y + at * (to.y - from.y), arm = few ? 4 : 2.5;
        context.moveTo(x - arm, y - arm); context.lineTo(x + arm, y + arm);
        context.moveTo(x + arm, y - arm); context.lineTo(x - arm, y + arm);
      }
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  vehicles(context, run, swarm) {
    const { radius } = this;
    run.roster.forEach((id, index) => {
      const agent = swarm.agents.get(id), at = this.placed.get(id), [fill, stroke, text, dashed] = run.inks[index];
      const type = run.types[index];
      context.save();
      context.translate(at.x, at.y);
      if (agent.state === "gone") {
        cross(context, radius * 0.8);
        context.restore();
        return;
      }
      if (this.chosen.has(id)) halo(context, radius + 8, colour("ink"), [2, 2]);
      if (agent.doing === "voting") halo(context, radius + 4, colour("vote"), []);
      if (swarm.reconcilingNow(agent)) halo(context, radius + 4, colour("reconcile"), [5, 3]);
      context.save();
      if (type !== "copter" && at.course !== null) context.rotate(at.course);
      context.beginPath();
      d3.symbol(shape(type), Math.PI * radius * radius * (type === "plane" ? 0.9 : 1.05)).context(context)();
      context.globalAlpha = agent.state === "down" ? 0.25 : agent.state === "still" ? 0.6 : 1;
      context.fillStyle = fill;
      context.fill();
      context.globalAlpha = 1;
      context.strokeStyle = stroke;
      context.lineWidth = 1.75;
      context.setLineDash(dashed ? [2, 2] : []);
      context.stroke();
      context.restore();
      context.fillStyle = agent.state === "down" ? colour("ink") : text;
      context.font = font(Math.max(8.5, radius * (String(id).length > 2 ? 0.75 : 1)), 600);
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText(String(id), 0, type === "plane" ? radius * 0.12 : 0.5);
      context.textBaseline = "alphabetic";
      if (agent.state === "down") cross(context, radius * 0.5, radius, -radius);
      if (agent.state === "still") bars(context, radius);
      context.restore();
    });
  }

  // The vehicle at that place of the window, or null.
  nearest(atX, atY) {
    let nearest = null, least = this.radius + 6;
    for (const [id, { x, y }] of this.placed) {
      const away = Math.hypot(x - atX, y - atY);
      if (away < least) { nearest = id; least = away; }
    }
    return nearest;
  }

  lines(id, swarm) {
    const agent = swarm.agents.get(id), at = this.placed.get(id), type = swarm.run.types[swarm.run.roster.indexOf(id)];
    const state = { down: "agent down", gone: "lost", still: "paused" }[agent.state] ?? agent.doing;
    return [
      `vehicle ${id}, a ${type}${at.up === null ? "" : `, ${at.up.toFixed(0)} m up`}`,
      `${state}${agent.more && agent.state === "up" && agent.doing !== "voting" ? `: ${agent.more}` : ""}`,
      `chain of ${agent.chain.length}, waiting ${agent.deque.length}, on its stack ${agent.stack.length}`,
    ];
  }

  // About the vehicle under the pointer, or at which the keyboard is.
  told(context, swarm, width, height) {
    const nearest = this.pointer ? this.nearest(...this.pointer) : this.focused;
    if (nearest === null) return;
    const at = this.placed.get(nearest), lines = this.lines(nearest, swarm);
    context.font = font(12);
    const wide = Math.max(...lines.map((line) => context.measureText(line).width)) + 20, tall = 18 * lines.length + 12;
    const x = Math.min(at.x + 16, width - wide - 8), y = Math.min(Math.max(at.y - tall / 2, 8), height - tall - 8);
    context.fillStyle = colour("ground");
    context.strokeStyle = colour("rule");
    context.beginPath();
    context.roundRect(x, y, wide, tall, 5);
    context.fill();
    context.stroke();
    context.textAlign = "left";
    lines.forEach((line, row) => {
      context.fillStyle = colour(row ? "quiet" : "ink");
      context.fillText(line, x + 10, y + 19 + 18 * row);
    });
  }
}

export { PULSE_WALL_S };

const around = ({ x, y }, radius) => d3.range(8).map((step) => [x + radius * Math.cos(step * Math.PI / 4), y + radius * Math.sin(step * Math.PI / 4)]);

function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((step) => step * power >= least);
}

function halo(context, radius, paint, dash) {
  context.beginPath();
  context.arc(0, 0, radius, 0, 2 * Math.PI);
  context.strokeStyle = paint;
  context.lineWidth = 2.5;
  context.setLineDash(dash);
  context.stroke();
  context.setLineDash([]);
}

function cross(context, arm, x = 0, y = 0) {
  context.beginPath();
  context.moveTo(x - arm, y - arm); context.lineTo(x + arm, y + arm);
  context.moveTo(x + arm, y - arm); context.lineTo(x - arm, y + arm);
  context.strokeStyle = colour("lost");
  context.lineWidth = 3;
  context.stroke();
}

function bars(context, radius) {
  context.fillStyle = colour("lost");
  context.fillRect(radius - 2, -radius - 4, 3, 9);
  context.fillRect(radius + 3, -radius - 4, 3, 9);
}
