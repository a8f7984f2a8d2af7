// Zooming in the timeline, and the messages between its lanes. Without this the page shows the whole run.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const MOST_ARROWS = 120, SHORTEST_S = 0.05, ZOOM = 1.6, SHIFT = 0.25;
  const timeline = document.querySelector(".timeline");
  const end = Number(timeline.dataset.end), lane = Number(timeline.dataset.lane);
  const messages = JSON.parse(timeline.dataset.messages);
  const plots = [...timeline.querySelectorAll(".plot")], ticks = timeline.querySelector(".ticks");
  const views = plots.map(plot => plot.querySelector(".view"));
  const pins = plots.flatMap(plot => [...plot.querySelectorAll(".pin")]);
  const arrows = plots[0].querySelector(".arrows"), said = timeline.querySelector("output");
  const arrowCount = messages ? messages.sent.reduce((count, message) => count + message[4].length, 0) : 0;
  let from = 0, until = end;

  const add = (parent, name, attributes, text) => {
    const element = parent.appendChild(document.createElementNS(SVG, name));
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const share = at => `${100 * (at - from) / (until - from)}%`;
  const place = pin => {
    const at = Number(pin.dataset.at);
    pin.setAttribute("x", share(at));
    pin.style.display = at < from || at > until ? "none" : "";
  };

  function show(newFrom, newUntil) {
    const span = Math.min(Math.max(newUntil - newFrom, SHORTEST_S), end);
    from = Math.min(Math.max(newFrom, 0), end - span);
    until = from + span;
    for (const view of views) view.setAttribute("viewBox", `${from} 0 ${span} ${view.getAttribute("height")}`);
    pins.forEach(place);
    const digits = drawTicks(span);
    const drawn = drawArrows();
    said.textContent = `${from.toFixed(digits)} to ${until.toFixed(digits)} s${drawn}`;
    for (const button of timeline.querySelectorAll("button")) {
      const todo = button.dataset.do;
      button.disabled = todo === "in" ? span <= SHORTEST_S : todo === "earlier" ? from <= 0
        : todo === "later" ? until >= end : span >= end;
    }
  }

  function drawTicks(span) {
    const unit = 10 ** Math.floor(Math.log10(span / 5));
    const step = [1, 2, 2.5, 5, 10].map(factor => factor * unit).find(one => one * 5 >= span * (1 - 1e-9));
    const digits = Math.min(Math.max(0, 1 - Math.floor(Math.log10(step))), step >= 1 ? 0 : 3);
    ticks.replaceChildren();
    for (let number = Math.ceil(from / step - 1e-9); number * step <= until + step * 1e-9; number += 1) {
      const mark = add(ticks, "svg", {class: "pin", x: share(number * step)});
      add(mark, "path", {d: "M0 0v4"});
      add(mark, "text", {y: 17, "text-anchor": "middle"}, String(Number((number * step).toFixed(3))));
    }
    return digits;
  }

  function drawArrows() {
    arrows.replaceChildren();
    if (!messages) return "";
    const seen = [];
    for (const message of messages.sent)
      for (const receipt of message[4])
        if (message[0] <= until && receipt[1] >= from) seen.push([message, receipt]);
    if (seen.length > MOST_ARROWS) return `, zoom in for ${seen.length} of ${arrowCount} messages heard`;
    const width = plots[0].getBoundingClientRect().width;
    for (const [[sentAt, sender, kind, block], [receiver, at]] of seen) {
      const x1 = (sentAt - from) / (until - from) * width, x2 = (at - from) / (until - from) * width;
      const y1 = (sender + 0.5) * lane, y2 = (receiver + 0.5) * lane;
      const name = messages.kinds[kind], long = Math.hypot(x2 - x1, y2 - y1) || 1;
      const dx = (x2 - x1) / long, dy = (y2 - y1) / long;
      const arrow = add(arrows, "g", {});
      add(arrow, "title", {}, `${name}${block && ` ${block}`}, agent ${messages.agents[sender]} to `
        + `${messages.agents[receiver]}: sent at ${sentAt} s, handled at ${at} s`);
      const look = /Response/.test(name) ? " answer" : "";
      const heavy = name === "Commit Block" || name === "Block Response" ? " carries" : "";
      add(arrow, "path", {class: `arrow${look}${heavy}`, d: `M${x1} ${y1}L${x2 - 5 * dx} ${y2 - 5 * dy}`});
      add(arrow, "path", {class: "head", d: `M${x2} ${y2}l${-8 * dx - 3 * dy} ${-8 * dy + 3 * dx}l${6 * dy} ${-6 * dx}z`});
    }
    return seen.length ? `, ${seen.length} messages heard` : "";
  }

  const zoom = (factor, at) => show(at - (at - from) / factor, at + (until - at) / factor);
  const middle = () => (from + until) / 2;
  const shift = part => show(from + part * (until - from), until + part * (until - from));
  const actions = {
    in: () => zoom(ZOOM, middle()),
    out: () => zoom(1 / ZOOM, middle()),
    earlier: () => shift(-SHIFT),
    later: () => shift(SHIFT),
    all: () => show(0, end),
  };
  const keys = {"+": "in", "=": "in", "-": "out", ArrowLeft: "earlier", ArrowRight: "later", Home: "all", 0: "all"};

  timeline.addEventListener("click", event => {
    const button = event.target.closest("button");
    if (button) actions[button.dataset.do]();
  });
  timeline.addEventListener("keydown", event => {
    if (!keys[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    actions[keys[event.key]]();
  });

  for (const plot of plots) {
    const timeAt = event => {
      const box = plot.getBoundingClientRect();
      const part = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
      return from + part * (until - from);
    };
    let start = null, selected = null;
    const stop = () => {
      if (selected) selected.remove();
      start = selected = null;
    };
    plot.addEventListener("wheel", event => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      zoom(event.deltaY < 0 ? ZOOM : 1 / ZOOM, timeAt(event));
    }, {passive: false});
    plot.addEventListener("pointerdown", event => {
      if (event.button !== 0 || event.pointerType === "touch") return;
      event.preventDefault();
      timeline.focus({preventScroll: true});
      plot.setPointerCapture(event.pointerId);
      start = {at: timeAt(event), x: event.clientX};
    });
    plot.addEventListener("pointermove", event => {
      if (!start || (!selected && Math.abs(event.clientX - start.x) < 4)) return;
      selected = selected || add(plot, "rect", {class: "selected", height: "100%"});
      const at = timeAt(event);
      selected.setAttribute("x", share(Math.min(at, start.at)));
      selected.setAttribute("width", `${100 * Math.abs(at - start.at) / (until - from)}%`);
    });
    plot.addEventListener("pointerup", event => {
      const chosen = start && selected && [start.at, timeAt(event)].sort((one, other) => one - other);
      stop();
      if (chosen) show(...chosen);
    });
    plot.addEventListener("pointercancel", stop);
    plot.closest(".row").classList.add("selects");
  }

  timeline.tabIndex = 0;
  timeline.setAttribute("aria-label", "Timeline: + and - zoom, arrow keys move, Home shows the whole run");
  timeline.querySelector(".controls").hidden = false;
  addEventListener("resize", () => show(from, until));
  addEventListener("beforeprint", actions.all);
  show(0, end);
})();
