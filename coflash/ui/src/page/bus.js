// The frames on the bus in words, and the bus load over time.

import { $, el, text } from "./dom.js";

/** Frames that the page keeps, and that it shows at a time. */
const KEPT = 5000;
const SHOWN = 200;
/** Seconds of the plot. */
const SPAN = 180;

let rows = [];
let seconds = new Map();
let now = 0;
let dirty = false;
let plot = null;

export function renew() {
  rows = [];
  seconds = new Map();
}

/** Takes over the bus data of an event. */
export function take(event) {
  if (event.frames?.length) {
    const last = rows.length ? rows[rows.length - 1].number : 0;
    rows.push(...event.frames.filter((row) => row.number > last));
    if (rows.length > KEPT) rows.splice(0, rows.length - KEPT);
    dirty = true;
  }
  for (const second of event.seconds ?? []) seconds.set(second.second, second);
  for (const key of seconds.keys()) if (key < event.now - 600) seconds.delete(key);
  if (event.now !== now) {
    now = event.now;
    draw();
  }
  if (dirty && !$("hold").checked) list();
}

const clock = (seconds) => {
  const time = new Date(seconds * 1000);
  const two = (part) => String(part).padStart(2, "0");
  return `${two(time.getHours())}:${two(time.getMinutes())}:${two(time.getSeconds())}.${String(time.getMilliseconds()).padStart(3, "0")}`;
};

/** All words have to be in a frame; "node 5" is one. */
function wanted() {
  const parts = $("filter").value.toLowerCase().match(/node \d+|\S+/g) ?? [];
  const tests = parts.map((part) => {
    const node = /^node (\d+)$/.exec(part);
    if (!node) return (words) => words.includes(part);
    const exact = new RegExp(`node ${node[1]}(?!\\d)`);
    return (words) => exact.test(words);
  });
  return (row) => {
    const words = `${row.frame} ${row.words}`.toLowerCase();
    return tests.every((test) => test(words));
  };
}

function list() {
  dirty = false;
  const fits = wanted();
  const found = [];
  for (let at = rows.length - 1; at >= 0 && found.length < SHOWN; at -= 1) if (fits(rows[at])) found.push(rows[at]);
  $("frame-rows").replaceChildren(...found.map((row) => el("tr", { class: row.own ? "own" : "" },
    el("td", {}, clock(row.time)), el("td", {}, el("code", {}, row.frame)), el("td", {}, row.words))));
}

function data() {
  const rate = Number($("bit-rate").value);
  const times = [];
  const loads = [];
  for (let second = now - SPAN; second < now; second += 1) {
    times.push(second);
    loads.push(((seconds.get(second)?.bits ?? 0) / rate) * 100);
  }
  return [times, loads];
}

function draw() {
  const values = data();
  const last = seconds.get(now - 1);
  const load = values[1][values[1].length - 1];
  const over = load > 100 ? ": this bus is faster than the bit rate that is chosen" : "";
  text($("load"), `${(load ?? 0).toFixed(1)} % load, ${last?.frames ?? 0} frames in the last second${over}`);
  if (plot) plot.setData(values);
}

function make() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  plot?.destroy();
  const axis = { stroke: colour("--text"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 }, font: "12px system-ui, sans-serif" };
  plot = new uPlot({
    width: $("plot").clientWidth, height: 160, legend: { show: false }, cursor: { show: false },
    scales: { x: { time: true }, y: { range: (_, low, high) => [0, Math.max(5, high * 1.1)] } },
    axes: [{ ...axis, space: 80 }, { ...axis, size: 52, values: (_, marks) => marks.map((mark) => `${mark} %`) }],
    series: [{}, { label: "load", stroke: colour("--accent"), fill: colour("--accent-soft"), width: 1.5, points: { show: false } }],
  }, data(), $("plot"));
}

export function start() {
  make();
  new ResizeObserver(() => plot.setSize({ width: $("plot").clientWidth, height: 160 })).observe($("plot"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", make);
  $("bit-rate").addEventListener("change", draw);
  $("filter").addEventListener("input", list);
  $("hold").addEventListener("change", () => { if (!$("hold").checked) list(); });
}
