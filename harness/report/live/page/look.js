// How things look, for all that is drawn: colours of the page's style, canvases as sharp as the screen, words.

const root = document.documentElement;
let known = new Map();

export function colour(name) {
  if (!known.has(name)) known.set(name, getComputedStyle(root).getPropertyValue(`--${name}`).trim());
  return known.get(name);
}

export function whenColoursChange(then) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { known = new Map(); then(); });
}

// The canvas as large as it is shown, and its context in CSS pixels, wiped.
export function prepared(canvas, height) {
  const ratio = devicePixelRatio || 1;
  const width = canvas.clientWidth, tall = height ?? canvas.clientHeight;
  if (height !== undefined && canvas.style.height !== `${height}px`) canvas.style.height = `${height}px`;
  const [w, h] = [Math.round(width * ratio), Math.round(tall * ratio)];
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, tall);
  context.font = font(12);
  return { context, width, height: tall };
}

export const font = (px, weight = 400) => `${weight} ${px}px system-ui, -apple-system, "Segoe UI", Roboto, sans-serif`;

export function clock(seconds) {
  const whole = Math.max(0, Math.floor(seconds + 1e-6));
  const hours = Math.floor(whole / 3600), minutes = Math.floor(whole / 60) % 60;
  const pad = (number) => String(number).padStart(2, "0");
  return hours ? `${hours}:${pad(minutes)}:${pad(whole % 60)}` : `${minutes}:${pad(whole % 60)}`;
}

export const percent = (share) => `${(100 * share).toFixed(share > 0 && share < 0.0995 ? 1 : 0)} %`;

// The strokes of links, by quality. The feed sends the limits of the qualities and their words.
export const LINKS = [
  { dash: [], width: 1, alpha: 0.55, colour: "whole" },
  { dash: [9, 3], width: 1, alpha: 0.7, colour: "whole" },
  { dash: [5, 4], width: 1.1, alpha: 0.9, colour: "poor" },
  { dash: [1.5, 4], width: 1.5, alpha: 0.95, colour: "bad" },
];

export const partColour = (number) => `part${number % 4}`;

// Which family a message is of; one that is not known is of none.
export function family(message) {
  if (message.startsWith("Block Add")) return "vote";
  if (message.startsWith("Commit")) return "commit";
  return "reconcile";
}

const SHAPES = { copter: d3.symbolCircle, plane: d3.symbolTriangle, rover: d3.symbolSquare, boat: d3.symbolSquare, sub: d3.symbolDiamond };
export const shape = (type) => SHAPES[type] ?? d3.symbolDiamond;
