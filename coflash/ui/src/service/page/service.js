// The page of a service station. The server decides; the page shows it in the user's language and sends requests.

import { $, el, text } from "./dom.js";
import { follow, post } from "./events.js";
import { keep, keepField, kept } from "./kept.js";

const FIELDS = ["operator", "order", "device-number"];
const MARKS = {
  "state-has": "✓", "state-due": "→", "state-older": "!", "state-left-out": "–", "state-waiting": "…", "state-working": "", "state-updated": "✓",
  "state-failed": "✗",
};
const BANNER = { good: "✓", complete: "✓", bad: "✗", none: "✗", "other-machine": "✗", lost: "✗", searching: "", working: "", "planned-bad": "!", "good-unsaved": "!" };

let words = {};
let language = kept("language") ?? (navigator.language.toLowerCase().startsWith("de") ? "de" : "en");
/** What does not change while the station runs. */
let station = null;
let state = null;
/** The devices of the plan that get their programs; all that need them, and none that would get an older one, until the
 * user chooses. */
let chosen = new Set();
/** The number of the plan that was chosen from. */
let plan = null;
/** Whether the user changes the adapter. */
let changes = false;
/** The device number that was sent with an update, until the server shows that it took the update. */
let sent = null;
/** The device number of the update at work, which comes back if no device was changed. */
let taken = "";
let sound = null;
/** What had the focus last; null until the user goes somewhere. */
let place = null;
let shown = "";

/** The text with this key in the language of the user. */
function t(key, values = {}) {
  // A name may have any text: what is filled in is no pattern, and is not filled in again.
  return words[key][language].replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
}

const hex = (number) => number.toString(16).toUpperCase().padStart(8, "0") + "h";

/** A message of the server: the text, and below it what the library says, for whoever helps. */
function message(told, left) {
  const detail = [told.detail, told.number === null ? null : `[0x${told.number.toString(16).padStart(8, "0")}]`];
  return [
    el("p", {}, t(told.key, told.values), left ? " " + t(left) : null),
    el("p", { class: "detail", lang: "en" }, detail.filter((part) => part !== null).join(" ")),
  ];
}

/** Whether a device can be chosen. */
const isDue = (row) => row.state === "state-due" || row.state === "state-older";

/** Enters the texts that are always on the page. */
function translate() {
  document.documentElement.lang = language;
  for (const element of document.querySelectorAll("[data-t]")) text(element, t(element.dataset.t));
  for (const element of document.querySelectorAll("[data-t-label]")) element.ariaLabel = t(element.dataset.tLabel);
  for (const button of $("languages").children) button.ariaPressed = String(button.dataset.language === language);
  const { name, release, file, date, signature } = station.package;
  const named = [name, release].filter((part) => part !== null).join(" ");
  const dated = date === null ? "" : " · " + t("of-date", { date });
  text($("package"), `${t(station.package.kind)}: ${named ? `${named} (${file})` : file}${dated}${signature === null ? "" : ` · ${t(signature)}`}`);
  station.adapters.forEach(({ kind, name, product, state }, index) =>
    text($("adapter-list").options[index], [t(kind, { name }), product, state in words ? t(state) : state].filter(Boolean).join(" · ")));
  document.title = `${named || file} – coflash`;
  shown = "";
  if (state) show(state);
}

function show(next) {
  const before = state;
  state = next;
  if (state.plan !== null && state.plan !== plan) {
    plan = state.plan;
    // After a reload of the page, what the user has left out of this plan stays so.
    const due = state.rows.filter((row) => row.state === "state-due").map((row) => row.node);
    chosen = new Set(kept("chosen")?.plan === plan ? kept("chosen").nodes : due);
  }
  if (state.open && !before?.open) changes = false;
  const from = before?.station;
  if (from === "working" && ["good", "good-unsaved", "bad"].includes(state.station)) play(state.station === "good");
  numbers(from);
  banner();
  adapter();
  unsaved();
  buttons();
  rows();
  text($("saved-count"), state.saved.length === 1 ? t("saved-one") : t("saved-many", { count: state.saved.length }));
  $("saved").hidden = state.saved.length === 0;
  $("sheet").hidden = !state.sheet;
  $("saved-names").replaceChildren(...state.saved.map((name) => el("li", {}, el("code", {}, name))));
  focus();
}

/**
 * What had the focus may be hidden or switched off now: the focus goes to what is to be done next, so that a person at the
 * keys does not begin at the top of the page. A plan with faults is looked at first: its next step is another search.
 */
function focus() {
  const takes = (element) => element.checkVisibility() && !element.disabled;
  if (place === null || $("confirm").open || takes(place)) return;
  const next = ["stop", "save", state.station === "planned" ? "update" : "search", "search", "connect", "change"];
  next.map($).find(takes)?.focus();
}

/**
 * The device number belongs to one machine: what is read after it was taken is for the next one. Only the server's states
 * decide, in their order: the answer to the request may come before or after any of them, and a short state may be missing.
 */
function numbers(from) {
  const field = $("device-number");
  if (from === "working" && state.plan !== null && field.value === "") enter(field, taken);
  if (sent === null || sent !== state.device_number) return;
  if (field.value.trim() === sent) enter(field, "");
  [taken, sent] = [sent, null];
}

function banner() {
  $("banner").dataset.station = state.station;
  text($("mark"), BANNER[state.station] ?? "●");
  text($("state"), t(state.says));
  text($("hint"), state.hint === null ? "" : t(state.hint));
  $("number").hidden = state.device_number === "";
  text($("number"), `${t("device-number")}: ${state.device_number}`);
  const now = JSON.stringify([state.message, language]);
  if ($("message").dataset.now !== now) {
    $("message").dataset.now = now;
    $("message").hidden = state.message === null;
    $("message").replaceChildren(...(state.message ? message(state.message) : []));
  }
}

function adapter() {
  const isOpen = state.open && !changes;
  $("adapter-open").hidden = !isOpen;
  $("adapter-form").hidden = isOpen;
  $("password-field").hidden = !state.asks_password;
  $("report").hidden = $("devices").hidden = !state.open && state.rows.length === 0;
  text($("adapter-name"), state.adapter);
  for (const id of ["change", "connect"]) $(id).disabled = state.busy;
}

function unsaved() {
  const now = JSON.stringify([state.why, state.unsaved, language]);
  if ($("unsaved").dataset.now === now) return;
  $("unsaved").dataset.now = now;
  $("unsaved").hidden = state.unsaved === 0;
  text($("unsaved-count"), t("unsaved", { count: state.unsaved }));
  text($("unsaved-why"), state.why ? t(state.why.key, state.why.values) : "");
  text($("unsaved-detail"), state.why?.detail ?? "");
  $("takes").replaceChildren(...Array.from({ length: state.unsaved }, (_, number) =>
    el("a", { class: "button", href: `report?number=${number}`, download: true }, t("take-report", { number: number + 1 }))));
}

function buttons() {
  const isPlanned = state.plan !== null;
  const isReport = chosen.size === 0 && !state.rows.some((row) => row.state === "state-due");
  text($("search"), state.plans === 0 ? t("search") : t("search-again"));
  $("search").hidden = state.busy;
  $("search").disabled = !state.open;
  $("search").classList.toggle("main", !isPlanned || state.station === "none");
  $("update").hidden = !isPlanned || state.station === "none" || state.busy;
  text($("update"), isReport ? t("save-report")
    : chosen.size === 0 ? t("update-none") : chosen.size === 1 ? t("update-one") : t("update-many", { count: chosen.size }));
  $("update").disabled = !state.open || (!isReport && chosen.size === 0);
  $("stop").hidden = !state.busy;
  $("stop").disabled = state.cancelling;
  text($("stop"), state.cancelling ? t("stopping") : t("stop"));
  // There is nothing to be stopped any more.
  if (!state.busy && $("confirm").open) $("confirm").close();
}

/** The devices. They are made anew only when one has changed. */
function rows() {
  const now = JSON.stringify([state.rows.map((row) => ({ ...row, percent: null })), state.plan, state.others, language]);
  if (now !== shown) {
    shown = now;
    const focused = document.activeElement?.id;
    $("rows").replaceChildren(...state.rows.map(row));
    if (focused) $(focused)?.focus();
    $("others").hidden = state.others.length === 0;
    $("others").replaceChildren(el("p", {}, t("others")), el("ul", {}, ...state.others.map(other)));
  }
  state.rows.forEach((row, index) => {
    const bar = $("rows").children[index].querySelector("progress");
    if (bar && row.percent !== null) bar.value = row.percent;
    const percent = $("rows").children[index].querySelector(".percent");
    if (percent) text(percent, row.percent === null ? "" : `${row.percent} %`);
  });
}

function row(one) {
  const isChoice = state.plan !== null && isDue(one);
  const head = one.node === null ? t("missing-device") : `${t("node")} ${one.node}`;
  const serial = one.identity[3];
  const box = isChoice
    ? el("input", {
      type: "checkbox", id: `choose-${one.node}`, "aria-label": t("choose-node", { node: one.node }),
      onchange: (event) => {
        if (event.target.checked) chosen.add(one.node);
        else chosen.delete(one.node);
        keep("chosen", { plan, nodes: [...chosen] });
        buttons();
      },
    })
    : el("span", { class: "mark", "aria-hidden": "true" }, MARKS[one.state]);
  if (isChoice) box.checked = chosen.has(one.node);
  const step = (step) => el("li", {},
    el("span", {}, `${step.program}: `),
    el("span", { class: "version" }, step.from ?? t("no-program"), el("span", { class: "arrow" }, " → "), el("strong", {}, step.to)),
    one.steps.length > 1 ? el("span", { class: "faint" }, ` · ${t(step.state)}`) : null,
    step.every_version_has_this_crc ? el("span", { class: "faint" }, " · " + t("every-version-has-this-crc")) : null);
  return el("li", { class: "device", "data-state": one.state, "data-node": one.node },
    box,
    el("div", { class: "what" },
      el("p", {}, el("strong", { class: "head" }, head), one.name ? ` · ${one.name}` : ""),
      serial === null ? null : el("p", { class: "faint" }, `${t("serial")}: `, el("code", {}, hex(serial))),
      one.steps.length > 0 ? el("ul", { class: "steps" }, ...one.steps.map(step)) : null,
      one.state === "state-working" ? el("progress", { max: "100", "aria-label": head }) : null,
      ...(one.trouble ? message(one.trouble, one.left) : [])),
    el("p", { class: "state" }, t(one.says), el("span", { class: "percent" })));
}

/** A device that is left alone. */
function other(one) {
  const said = [one.name, one.identity && `${t("identity")}: ${one.identity.slice(0, 3).map((part) => (part === null ? t("report-unknown") : hex(part))).join(" / ")}`];
  return el("li", {}, `${t("node")} ${one.node}: `, said.filter(Boolean).join(" · "), ...(one.trouble ? message(one.trouble) : []));
}

/** Two tones up for a good end, two down for a bad one. */
function play(isGood) {
  if (!sound) return;
  const tones = isGood ? [660, 880] : [440, 220];
  tones.forEach((frequency, index) => {
    const [tone, volume, at] = [sound.createOscillator(), sound.createGain(), sound.currentTime + index * 0.2];
    tone.frequency.value = frequency;
    volume.gain.setValueAtTime(0.2, at);
    volume.gain.exponentialRampToValueAtTime(0.001, at + 0.35);
    tone.connect(volume).connect(sound.destination);
    tone.start(at);
    tone.stop(at + 0.35);
  });
}

/** Asks the server for something. Shows a refusal to the user; true if there was none. */
async function ask(what, value = {}) {
  let said = t("refused");
  let told = "";
  try {
    const response = await post(what, { headers: { "content-type": "application/json" }, body: JSON.stringify(value) });
    if (response.ok) return true;
    told = await response.text();
  } catch (error) {
    said = error.name === "TimeoutError" ? t("no-answer") : t("not-sent");
  }
  try {
    told = JSON.parse(told).words;
  } catch {
    // It is not one of the page's own refusals.
  }
  $("message").hidden = false;
  $("message").dataset.now = "";
  $("message").replaceChildren(el("p", {}, said), el("p", { class: "detail", lang: "en" }, told));
  return false;
}

/** Enters a value as if the user had typed it. */
function enter(field, value) {
  field.value = value;
  field.dispatchEvent(new Event("input"));
}

/** A barcode reader types its characters and Enter, some Enter twice, whatever has the focus. It presses no button. */
function barcodes() {
  const fields = FIELDS.map($);
  const next = () => fields.find((field) => field.value === "");
  for (const field of fields) {
    field.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || event.isComposing) return;
      event.preventDefault();
      // The number that is read next replaces this one.
      const field = next() ?? $("device-number");
      field.focus();
      field.select();
    });
  }
  // Whether the last keys were characters, or characters and Enter: the next Enter is a reader's.
  let isRead = false;
  document.addEventListener("pointerdown", () => (isRead = false));
  document.addEventListener("keydown", (event) => {
    if (event.key === "Enter") {
      if ((isRead || event.repeat) && event.target.matches("button")) event.preventDefault();
      return;
    }
    const isCharacter = event.key.length === 1 && event.key !== " " && !event.ctrlKey && !event.altKey && !event.metaKey;
    isRead = isCharacter;
    if (!isCharacter || $("report").hidden || $("confirm").open || event.target.matches("input[type=text], input[type=password], select")) return;
    event.preventDefault();
    // Of a station at work, the number is what changes from machine to machine.
    const field = next() ?? $("device-number");
    field.focus();
    enter(field, event.key);
  });
}

/** The adapters, with the one of the last time chosen. */
function offer() {
  const [list, rate] = [$("adapter-list"), $("rate")];
  const base = (url) => url.split("@")[0];
  const known = station.adapters.map((one) => base(one.url));
  list.prepend(...station.adapters.map((one) => el("option", { value: base(one.url), "data-rate": one.url.includes("@") })));
  const [last, lastRate] = (station.last ?? "").split("@");
  // The list has no port with a speed of its own.
  if (known.includes(last) && !station.last.includes("?")) list.value = last;
  else if (last !== "") [list.value, $("address").value] = ["", station.last];
  else list.selectedIndex = 0;
  if ([...rate.options].some((option) => option.value === lastRate)) rate.value = lastRate;
  const choose = () => {
    $("address-label").hidden = list.value !== "";
    $("rate-label").hidden = list.selectedOptions[0]?.dataset.rate === undefined;
  };
  choose();
  list.addEventListener("change", choose);
  $("adapter-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const url = list.value === "" ? $("address").value : list.value + ($("rate-label").hidden ? "" : `@${rate.value}`);
    if (await ask("open", { url })) changes = false;
  });
  $("change").addEventListener("click", () => {
    changes = true;
    adapter();
    list.focus();
  });
}

function start() {
  document.addEventListener("focusin", (event) => (place = event.target));
  $("search").addEventListener("click", () => ask("search"));
  $("save").addEventListener("click", () => ask("save"));
  // A browser allows sounds from a click on.
  document.addEventListener("click", () => (sound ??= new AudioContext()));
  $("update").addEventListener("click", async () => {
    const [operator, order, number] = FIELDS.map((id) => $(id).value.trim());
    const nodes = [...chosen].sort((a, b) => a - b);
    const password = $("password").value;
    $("password").value = "";
    sent = number;
    if (!(await ask("update", { plan: state.plan, nodes, password, operator, order, device_number: number, language }))) sent = null;
  });
  $("stop").addEventListener("click", () => (state.station === "working" ? $("confirm").showModal() : ask("cancel")));
  $("confirm").addEventListener("close", () => {
    if ($("confirm").returnValue === "yes") ask("cancel");
    $("confirm").returnValue = "";
  });
  for (const button of $("languages").children) {
    button.addEventListener("click", () => {
      language = button.dataset.language;
      keep("language", language);
      translate();
    });
  }
  FIELDS.forEach(keepField);
  text($("folder"), station.folder);
  text($("version"), `coflash ${station.version}`);
  barcodes();
}

[words, station] = await Promise.all(["words.json", "station"].map(async (name) => (await fetch(name)).json()));
offer();
start();
translate();
follow("", (told) => { if (told.state) show(told.state); }, (how) => ($("lost").hidden = how === null));
