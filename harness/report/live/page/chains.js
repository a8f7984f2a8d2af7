// Each vehicle's chain, block by block, coloured by who made it. What most hold at a height is filled plainly; a block
// that differs from it stands out, so that a fork is seen at once. What waits beside a chain follows it, smaller.

import { colour, font, prepared } from "./look.js";

const LABEL = 38;
const SHARE = 0.5;

export class Chains {
  constructor(canvas, story) {
    this.canvas = canvas;
    this.story = story;
  }

  draw(swarm) {
    const { run } = this.story, rows = run.roster.length;
    const tall = SHARE * document.getElementById("side").clientHeight;
    const row = Math.max(6, Math.min(24, Math.floor(tall / rows)));
    const { context, width } = prepared(this.canvas, rows * row + 15);
    const size = row >= 14 ? row - 6 : row - 1.5, step = Math.max(8, Math.min(size, 13) + 2);
    const block = Math.min(size, 13);
    const room = Math.max(8, Math.floor((width - LABEL - 8) / step) - 5);
    const longest = Math.max(0, ...run.roster.map((id) => swarm.agents.get(id).chain.length));
    const first = Math.max(0, longest - room);
    const usual = usualBlocks(swarm, first, longest);
    this.heights(context, first, longest, step, rows * row);
    run.roster.forEach((id, index) => {
      const agent = swarm.agents.get(id), y = index * row, middle = y + row / 2;
      this.label(context, swarm, id, index, y, row);
      context.globalAlpha = agent.state === "up" || agent.state === "still" ? 1 : 0.3;
      for (let height = first; height < agent.chain.length; height += 1) {
        const key = agent.chain[height], x = LABEL + (height - first) * step;
        context.fillStyle = this.paint(swarm, key);
        context.fillRect(x, middle - block / 2, step - 2, block);
        if (usual[height - first] === key) continue;
        context.strokeStyle = context.fillStyle = colour("lost");
        context.lineWidth = 2;
        if (row >= 12) context.strokeRect(x - 0.5, middle - block / 2 - 0.5, step - 1, block + 1);
        else context.fillRect(x - 1, middle + block / 2 - 0.75, step, 1.5);
      }
      const end = LABEL + (agent.chain.length - first) * step + 3, small = Math.max(4, block * 0.55);
      [...agent.stack].reverse().slice(0, 8).forEach((key, at) => {
        const x = end + at * (small + 2);
        context.strokeStyle = this.paint(swarm, key);
        context.lineWidth = 1.5;
        context.strokeRect(x + 0.75, middle - small / 2 + 0.75, small - 1.5, small - 1.5);
      });
      const beyond = end + Math.min(agent.stack.length, 8) * (small + 2) + (agent.stack.length ? 4 : 0);
      agent.deque.slice(0, 6).forEach((key, at) => {
        context.fillStyle = this.paint(swarm, key);
        context.beginPath();
        context.arc(beyond + at * (small + 1) + small / 2, middle, small / 2 - 0.5, 0, 2 * Math.PI);
        context.fill();
      });
      context.globalAlpha = 1;
    });
  }

  paint(swarm, key) {
    const maker = swarm.blocks.get(key);
    return maker ? this.story.run.inks[this.story.index.get(maker.agent)][0] : colour("whole");
  }

  label(context, swarm, id, index, y, row) {
    const { run } = this.story, agent = swarm.agents.get(id);
    const busy = swarm.reconcilingNow(agent) ? "reconcile" : agent.doing === "voting" ? "vote" : null;
    if (busy) {
      context.fillStyle = colour(busy);
      context.globalAlpha = 0.22;
      context.fillRect(0, y + 0.5, LABEL - 4, row - 1);
      context.globalAlpha = 1;
    }
    context.fillStyle = run.inks[index][0];
    context.fillRect(0, y + 1, 4, row - 2);
    if (row < 9 && index % 5) return;
    context.fillStyle = colour(agent.state === "up" ? "ink" : "quiet");
    context.font = font(Math.max(9, Math.min(12, row)), busy ? 700 : 500);
    context.textAlign = "right";
    context.textBaseline = "middle";
    context.fillText(String(id), LABEL - 9, y + row / 2 + 0.5);
    context.textBaseline = "alphabetic";
  }

  heights(context, first, longest, step, bottom) {
    context.font = font(10);
    context.fillStyle = colour("quiet");
    context.textAlign = "center";
    const every = step * 5 >= 40 ? 5 : 10;
    for (let height = Math.ceil((first + 1) / every) * every; height <= longest; height += every)
      context.fillText(String(height), LABEL + (height - 1 - first) * step + step / 2 - 1, bottom + 11);
  }
}

// What most vehicles have at each height.
function usualBlocks(swarm, first, longest) {
  const chains = swarm.living.map((id) => swarm.agents.get(id).chain);
  return d3.range(first, longest).map((height) => {
    const counts = d3.rollup(chains.filter((chain) => chain.length > height), (same) => same.length, (chain) => chain[height]);
    return d3.greatest(counts, ([, count]) => count)?.[0];
  });
}
