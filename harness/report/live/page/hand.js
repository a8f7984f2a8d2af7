// What somebody may have happen to a run that goes on: buttons for the swarm, and in virtual time for time itself. What
// cannot be is grey, and says why.

import { clock } from "./look.js";
import { element } from "./panel.js";

const HINT = "Choose vehicles on the map: click them, or press N and Enter.";

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
    this.button(swarm, "Part", "Separate the chosen vehicles from the others", true, () => ({ partition: this.parts() }), () => this.others().length > 0 || "leave at least one vehicle unchosen");
    this.button(swarm, "Heal", "End the partition", false, () => ({ heal: true }));
    this.loss = labelled(document.createElement("select"), "Loss");
    for (const share of [0, 0.05, 0.1, 0.15, 0.25, 0.5, 0.75, 1]) {
      const option = element("option", `loss ${100 * share} %`);
      option.value = share;
      option.selected = share === 0.25;
      this.loss.append(option);
    }
    swarm.append(this.loss);
    this.button(swarm, "Set", "Set the loss rate of all links", false, () => ({ loss: +this.loss.value }));
    const vehicles = group(this.root, "Vehicles");
    this.button(vehicles, "Kill", "Kill the chosen vehicles; their data is lost", true, () => ({ kill: this.ids() }));
    this.button(vehicles, "Reboot", "Reboot the computers of the chosen vehicles for 30 s; their disks are kept", true, () => ({ reboot: this.ids(), down_s: 30, disk: "kept" }));
    this.button(vehicles, "Replace", "Start new vehicles without data in place of chosen vehicles that were lost", true, () => ({ restart: this.ids() }));
    this.button(vehicles, "Reconcile", "Start a reconcile of the chosen agents", true, () => ({ reconcile: this.ids() }));
    this.trouble = group(this.root, "Trouble");
    const time = group(this.root, "Time");
    this.hold = this.command(time, "Hold", "Pause virtual time", () => ({ do: this.state.paused ? "go on" : "pause" }));
    this.command(time, "+1 s", "Pause after one second", () => ({ do: "step", seconds: 1 }));
    this.command(time, "+10 s", "Pause after ten seconds", () => ({ do: "step", seconds: 10 }));
    this.command(time, "Next step", "Pause after the next handler run of an agent", () => ({ do: "next run" }));
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
    const what = labelled(document.createElement("select"), "Vehicle fault");
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
    this.button(this.trouble, "Befall", "Apply the fault to the chosen vehicles", true, () => ({ [what.value]: this.ids(), ...keys() }), may);
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

  noTime() { return this.state.virtual ? null : "the time of real processes cannot be paused: use --backend sim, where time is virtual"; }

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
    this.speed.title = this.noTime() ?? "Mission seconds per second";
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
