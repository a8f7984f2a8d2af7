// What somebody may have happen to a run that goes on: buttons for the swarm, and in virtual time for time itself. What
// cannot be is grey, and says why.

import { clock } from "./look.js";
import { element } from "./panel.js";

const HINT = "Click vehicles on the map to choose some.";

export class Hand {
  constructor(root, ask, changed) {
    this.root = root;
    this.ask = ask;
    this.changed = changed;
    this.state = null;
    this.chosen = new Set();
    this.buttons = [];
    this.waiting = new Map();
    this.number = 0;
    this.build();
  }

  build() {
    const swarm = group(this.root, "Swarm");
    this.button(swarm, "Part", "The chosen vehicles and the others do not hear each other", true, () => ({ partition: this.parts() }), () => this.others().length > 0 || "somebody has to be left");
    this.button(swarm, "Heal", "No partition any more", false, () => ({ heal: true }));
    this.loss = labelled(document.createElement("select"), "Loss");
    for (const share of [0, 0.05, 0.1, 0.15, 0.25, 0.5, 0.75, 1]) {
      const option = element("option", `loss ${100 * share} %`);
      option.value = share;
      option.selected = share === 0.25;
      this.loss.append(option);
    }
    swarm.append(this.loss);
    this.button(swarm, "Set", "Every receiver loses so many messages", false, () => ({ loss: +this.loss.value }));
    const vehicles = group(this.root, "Vehicles");
    this.button(vehicles, "Kill", "The chosen vehicles are lost, and their data with them", true, () => ({ kill: this.ids() }));
    this.button(vehicles, "Reboot", "The chosen vehicles' computers are back after 30 s, with their disks", true, () => ({ reboot: this.ids(), down_s: 30, disk: "kept" }));
    this.button(vehicles, "Replace", "Others, with nothing, take the place of chosen ones that were lost", true, () => ({ restart: this.ids() }));
    this.button(vehicles, "Reconcile", "The chosen agents begin to reconcile", true, () => ({ reconcile: this.ids() }));
    this.trouble = group(this.root, "Trouble");
    const time = group(this.root, "Time");
    this.hold = this.command(time, "Hold", "Virtual time stands still", () => ({ do: this.state.paused ? "go on" : "pause" }));
    this.command(time, "+1 s", "Hold, but go on for a second", () => ({ do: "step", seconds: 1 }));
    this.command(time, "+10 s", "Hold, but go on for ten seconds", () => ({ do: "step", seconds: 10 }));
    this.command(time, "Next step", "Hold, but go on until an agent has run a handler", () => ({ do: "next run" }));
    this.speed = labelled(document.createElement("select"), "Speed of the run");
    for (const factor of [1, 2, 5, 10, 20, 50, 100, 500, null]) {
      const option = element("option", factor === null ? "fastest" : `${factor}×`);
      option.value = factor ?? "";
      this.speed.append(option);
    }
    this.speed.addEventListener("change", () => this.send({ do: "speed", factor: this.speed.value === "" ? null : +this.speed.value }));
    time.append(this.speed);
    this.said = element("output", HINT);
    this.said.setAttribute("aria-live", "polite");
    this.root.append(this.said);
  }

  // What can befall vehicles, each with its further keys and what these are unless somebody says otherwise.
  befall({ flown, troubles }) {
    const words = (name) => name.replaceAll("_", " ");
    const what = labelled(document.createElement("select"), "What befalls vehicles");
    for (const [name] of troubles) what.append(Object.assign(element("option", words(name)), { value: name }));
    const further = element("span");
    const ask = () => further.replaceChildren(...Object.entries(troubles.find(([name]) => name === what.value)[1]).flatMap(([key, value]) => {
      const input = labelled(document.createElement("input"), words(key));
      Object.assign(input, { type: "number", step: "any", name: key, value, required: true });
      return [input, element("small", words(key))];
    }));
    what.addEventListener("change", ask);
    ask();
    this.trouble.append(what, further);
    const keys = () => Object.fromEntries([...further.querySelectorAll("input")].map((input) => [input.name, input.valueAsNumber]));
    const may = () => flown || "needs vehicles that fly: use --backend process, and `vehicles.kind` embedded or ardupilot";
    this.button(this.trouble, "Befall", "It befalls the chosen vehicles", true, () => ({ [what.value]: this.ids(), ...keys() }), may);
    this.refresh();
  }

  // A button that has an entry of the timeline happen now.
  button(place, label, title, needsChosen, entry, may) {
    const button = element("button", label);
    button.type = "button";
    button.addEventListener("click", () => this.send({ do: "happen", entry: entry() }));
    place.append(button);
    this.buttons.push([button, title, () => this.state.closed ?? this.why(needsChosen, may)]);
  }

  // Why it cannot be; null if it can.
  why(needsChosen, may) {
    const possible = may?.() ?? true;
    if (possible !== true) return possible;
    return needsChosen && !this.chosen.size ? "choose vehicles on the map first" : null;
  }

  command(place, label, title, asked) {
    const button = element("button", label);
    button.type = "button";
    button.addEventListener("click", () => this.send(asked()));
    place.append(button);
    this.buttons.push([button, title, () => this.noTime()]);
    return button;
  }

  noTime() { return this.state.virtual ? null : "real processes cannot stand still: use --backend sim, where time is virtual"; }

  ids() { return [...this.chosen].sort((a, b) => a - b); }

  others() { return this.roster.filter((id) => !this.chosen.has(id)); }

  parts() { return [this.ids(), this.others()]; }

  choose(id) {
    if (this.chosen.has(id)) this.chosen.delete(id); else this.chosen.add(id);
    this.said.textContent = this.chosen.size ? `chosen: ${this.ids().join(" ")}` : HINT;
    this.refresh();
    this.changed();
  }

  send(asked) {
    this.number += 1;
    this.waiting.set(this.number, asked);
    this.ask({ number: this.number, ...asked });
  }

  answered(number, { at_s: at, error }) {
    const asked = this.waiting.get(number);
    this.waiting.delete(number);
    this.said.classList.toggle("refused", Boolean(error));
    this.said.textContent = error ?? `${asked?.entry ? Object.keys(asked.entry)[0] : asked?.do} at ${clock(at)} (${at.toFixed(1)} s)`;
    if (!error && asked?.entry) { this.chosen.clear(); this.refresh(); this.changed(); }
  }

  take(state) {
    this.state = state;
    this.speed.value = state.factor ?? "";
    if (state.factor !== null && this.speed.selectedIndex < 0) {
      const option = element("option", `${state.factor}×`);
      option.value = state.factor;
      this.speed.append(option);
      this.speed.value = state.factor;
    }
    this.hold.textContent = state.paused ? "Go on" : "Hold";
    this.refresh();
  }

  refresh() {
    if (!this.state) return;
    for (const [button, title, why] of this.buttons) {
      const reason = why();
      button.disabled = reason !== null;
      button.title = reason ?? title;
    }
    this.speed.disabled = this.noTime() !== null;
    this.speed.title = this.noTime() ?? "Mission seconds in a second";
  }
}

function labelled(field, label) {
  field.setAttribute("aria-label", label);
  return field;
}

function group(root, name) {
  const made = element("div");
  made.setAttribute("role", "group");
  made.setAttribute("aria-label", name);
  made.append(element("span", name));
  root.append(made);
  return made;
}
