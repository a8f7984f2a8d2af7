// All of the run that is known along one line of time: who voted and reconciled when, partitions, and how many chains
// there were. Under it lies the slider, on the same scale.

import { clock, colour, font, prepared } from "./look.js";

const LEFT = 54, RIGHT = 12, TOP = 16, HEADS = 30, AXIS = 16;

export class Timeline {
  constructor(canvas, story, seek) {
    this.canvas = canvas;
    this.story = story;
    this.picture = document.createElement("canvas");
    this.drawn = "";
    const go = (event) => seek(this.x.invert(event.offsetX));
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); go(event); });
    canvas.addEventListener("pointermove", (event) => { if (event.buttons & 1) go(event); else this.tell(event); });
  }

  // The mark nearest to the pointer, as a tooltip.
  tell(event) {
    const near = this.story.ahead.history.marks.filter((mark) => Math.abs(this.x(mark[1]) - event.offsetX) < 6);
    this.canvas.title = near.slice(0, 6).map(([, t, what, detail]) => `${clock(t)} ${what}: ${detail}`).join("\n");
  }

  draw(t, end, live) {
    const { run } = this.story, lane = Math.max(1.6, Math.min(11, 90 / run.roster.length));
    const lanes = Math.ceil(run.roster.length * lane), height = TOP + lanes + 6 + HEADS + AXIS;
    const { context, width } = prepared(this.canvas, height);
    this.x = d3.scaleLinear([0, Math.max(end, 1)], [LEFT, width - RIGHT]);
    const { history } = this.story.ahead;
    const now = `${history.version} ${Math.round(end)} ${width} ${devicePixelRatio} ${colour("ground")}`;
    if (now !== this.drawn && !(live && performance.now() - (this.when ?? 0) < 400)) {
      this.drawn = now;
      this.when = performance.now();
      this.paint(width, height, lane, lanes, end);
    }
    context.drawImage(this.picture, 0, 0, width, height);
    const x = this.x(t);
    context.strokeStyle = colour("ink");
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x, 4); context.lineTo(x, height - AXIS);
    context.stroke();
    context.fillStyle = colour("ink");
    context.beginPath();
    context.moveTo(x - 5, 0); context.lineTo(x + 5, 0); context.lineTo(x, 7);
    context.fill();
  }

  paint(width, height, lane, lanes, end) {
    const { picture, x } = this, { run, until } = this.story, { history } = this.story.ahead;
    const ratio = devicePixelRatio || 1;
    picture.width = width * ratio;
    picture.height = height * ratio;
    const context = picture.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.font = font(10);
    const known = Math.min(until, end);
    this.divisions(context, history, known, TOP, lanes);
    const row = new Map(run.roster.map((id, index) => [id, TOP + index * lane]));
    const gap = lane > 4 ? 1.5 : 0.4;
    const paints = { vote: colour("vote"), reconcile: colour("reconcile"), gone: colour("lost") };
    for (const { agent, what, from, to, how } of history.spans) {
      const left = x(from), wide = Math.max(1, x(to ?? known) - left);
      context.fillStyle = paints[what];
      context.globalAlpha = what === "gone" ? 0.25 : what === "vote" && how && how !== "approved" ? 0.4 : 0.9;
      context.fillRect(left, row.get(agent) + gap / 2, wide, lane - gap);
    }
    context.globalAlpha = 1;
    context.fillStyle = colour("quiet");
    context.textAlign = "right";
    if (lane >= 9) for (const [id, y] of row) context.fillText(String(id), LEFT - 7, y + lane - 2);
    else context.fillText("vehicles", LEFT - 7, TOP + lanes / 2 + 3);
    this.marks(context, history, lanes);
    this.heads(context, history, known, TOP + lanes + 6);
    this.axis(context, height, end);
  }

  // A ground under the time in which the swarm was in parts.
  divisions(context, history, known, top, lanes) {
    history.parts.forEach(([, t, parts], at) => {
      if (parts < 2) return;
      const until = history.parts[at + 1]?.[1] ?? known;
      context.fillStyle = colour("part2");
      context.globalAlpha = 0.16;
      context.fillRect(this.x(t), top - 3, Math.max(1, this.x(until) - this.x(t)), lanes + 6);
      context.globalAlpha = 1;
    });
  }

  marks(context, history, lanes) {
    context.fillStyle = context.strokeStyle = colour("ink");
    let last = -Infinity;
    for (const [, t, what] of history.marks) {
      const x = this.x(t);
      context.globalAlpha = 0.35;
      context.fillRect(x - 0.5, TOP - 3, 1, lanes + 4);
      context.globalAlpha = 1;
      const wide = context.measureText(what).width;
      if (x - last < 6) continue;
      context.textAlign = "left";
      context.fillText(what.replaceAll("_", " "), Math.min(x + 2, this.x.range()[1] - wide), TOP - 6);
      last = x + wide;
    }
  }

  // How many different chains there were among those that live: one is what the protocol is for.
  heads(context, history, known, top) {
    const most = Math.max(2, d3.max(history.heads, (step) => step[2]));
    const y = d3.scaleLinear([1, most], [top + HEADS - 3, top + 3]);
    const steps = [...history.heads.map(([, t, heads]) => [t, heads]), [known, history.heads.at(-1)[2]]];
    const area = d3.area((step) => this.x(step[0]), top + HEADS - 2, (step) => y(step[1])).curve(d3.curveStepAfter).context(context);
    context.beginPath();
    area(steps);
    context.globalAlpha = 0.18;
    context.fillStyle = colour("lost");
    context.fill();
    context.globalAlpha = 1;
    context.beginPath();
    d3.line((step) => this.x(step[0]), (step) => y(step[1])).curve(d3.curveStepAfter).context(context)(steps);
    context.strokeStyle = colour("lost");
    context.lineWidth = 1.25;
    context.stroke();
    context.fillStyle = colour("quiet");
    context.textAlign = "right";
    context.fillText(`${most} chains`, LEFT - 7, top + 9);
    context.fillText("1", LEFT - 7, top + HEADS);
  }

  axis(context, height, end) {
    context.fillStyle = colour("quiet");
    context.strokeStyle = colour("rule");
    context.textAlign = "center";
    const steps = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 36000, 86400];
    const wanted = end / Math.max(2, (this.x.range()[1] - LEFT) / 90);
    const step = steps.find((each) => each >= wanted) ?? wanted;
    for (let t = 0; t <= end; t += step) {
      const x = this.x(t);
      context.fillRect(x - 0.5, height - AXIS, 1, 4);
      context.fillText(clock(t), Math.max(LEFT, Math.min(x, this.x.range()[1] - 14)), height - 1);
    }
  }
}
