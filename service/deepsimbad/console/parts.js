// What several pages show alike.

import { html, useEffect, useRef, useState } from "./preact.js";
import { ask, json } from "./http.js";

export const metres = (value, digits = 1) => (value === null || value === undefined ? "–" : `${Math.abs(value) < 1e4 ? value.toFixed(Math.abs(value) >= 100 ? 0 : digits) : Math.round(value).toLocaleString()} m`);
export const percent = (share, digits = 0) => `${(100 * share).toFixed(digits)} %`;
export const bytes = (n) => (n < 1e3 ? `${n} B` : n < 1e6 ? `${(n / 1e3).toFixed(1)} kB` : n < 1e9 ? `${(n / 1e6).toFixed(1)} MB` : `${(n / 1e9).toFixed(1)} GB`);
export const when = (text, timeStyle = "short") => new Date(text).toLocaleString([], { dateStyle: "medium", timeStyle });

export function span(seconds) {
  if (seconds === null || seconds === undefined) return "unknown";
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

const RETRY_MS = 3000; // after a service that did not answer

// What a call answers, asked again when `every_ms` has passed, the service did not answer, or `again` is called; the last
// answer stays on a fault.
export function useAnswer(path, every_ms = 0) {
  const [state, setState] = useState({ answer: null, problem: null, path: null });
  const [count, setCount] = useState(0);
  useEffect(() => {
    if (!path) return undefined;
    const stop = new AbortController();
    let timer;
    const look = async () => {
      let wait_ms = every_ms;
      try {
        const answer = await json(path, { signal: stop.signal });
        setState({ answer, problem: null, path });
      } catch (problem) {
        if (problem.name === "AbortError") return;
        setState((before) => ({ answer: before.path === path ? before.answer : null, problem, path }));
        if (problem.status === 0) wait_ms ||= RETRY_MS;
      }
      if (wait_ms) timer = setTimeout(look, document.hidden ? 5 * wait_ms : wait_ms);
    };
    look();
    return () => {
      stop.abort();
      clearTimeout(timer);
    };
  }, [path, every_ms, count]);
  const isOf = state.path === path;
  return { answer: isOf ? state.answer : null, problem: isOf ? state.problem : null, again: () => setCount((n) => n + 1) };
}

const MOST_LISTED = 1000; // the service gives no more at once

// The same of a list, the newest of it; `more` asks for older ones where there are.
export function useList(path, every_ms) {
  const [limit, setLimit] = useState(100);
  const state = useAnswer(`${path}?limit=${limit}`, every_ms);
  const kept = useRef(null);
  kept.current = state.answer ?? kept.current;
  return { ...state, answer: kept.current, limit, more: () => setLimit(MOST_LISTED) };
}

export function More({ list }) {
  if (!list.answer?.next) return null;
  return html`<div class="row below">${list.limit < MOST_LISTED ? html`<button onClick=${list.more}>Show older ones</button>` : html`<p class="quiet">The newest ${MOST_LISTED.toLocaleString()} are shown.</p>`}</div>`;
}

const ADVICE = {
  no_connection: "What is shown is asked for again by itself; what you sent, send again.",
  unauthorized: "This service asks for a key: enter one above.",
  forbidden: "The key does not open this: it takes one of the scope admin.",
  unknown_domain: "Choose one under Domains.",
  unknown_session: "Open one under Sessions; those that ended long ago are known no more.",
  unknown_job: "Choose one under Jobs.",
  no_active_map: "Upload a traverse and remap, or activate a map version.",
};

export function Fault({ problem }) {
  if (!problem) return null;
  return html`<div class="notice bad" role="alert"><b>${problem.message}</b>${" "}
    <span class="quiet">${ADVICE[problem.code] ?? ""} ${problem.code ? html`<code>${problem.code}</code>` : ""}</span></div>`;
}

export function Loading({ what }) {
  return html`<p class="quiet" role="status">Loading ${what} …</p>`;
}

// A question before something is done; what it names is what changes.
export function confirmed(title, sentences, button) {
  const dialog = document.createElement("dialog");
  const heading = Object.assign(document.createElement("h2"), { textContent: title });
  const texts = sentences.map((text) => Object.assign(document.createElement("p"), { textContent: text }));
  const row = Object.assign(document.createElement("div"), { className: "row" });
  const no = Object.assign(document.createElement("button"), { textContent: "Cancel" });
  const yes = Object.assign(document.createElement("button"), { textContent: button, className: "first" });
  row.append(no, yes);
  dialog.append(heading, ...texts, row);
  dialog.setAttribute("aria-label", title);
  document.body.append(dialog);
  return new Promise((answer) => {
    yes.onclick = () => dialog.close("yes");
    no.onclick = () => dialog.close();
    dialog.onclose = () => {
      dialog.remove();
      answer(dialog.returnValue === "yes");
    };
    dialog.showModal();
  });
}

// Files dropped anywhere on the page, which the browser would else leave the page for.
export function useDropped(onFiles) {
  const latest = useRef(onFiles);
  latest.current = onFiles;
  useEffect(() => {
    const over = (event) => event.preventDefault();
    const dropped = (event) => {
      event.preventDefault();
      if (event.dataTransfer.files.length) latest.current(event.dataTransfer.files);
    };
    addEventListener("dragover", over);
    addEventListener("drop", dropped);
    return () => {
      removeEventListener("dragover", over);
      removeEventListener("drop", dropped);
    };
  }, []);
}

// What a frame is called, on one line; whole where a pointer rests.
export function Frame({ before = "", name }) {
  return html`<small class="frame" title=${name}>${before}${name}</small>`;
}

// A table that is perhaps wider than its place, and then scrolls by itself.
export function Wide({ label, children }) {
  return html`<div class="wide" role="region" aria-label=${label} tabindex="0">${children}</div>`;
}

// Thumbnails, asked for once each, the few last ones kept.
const pictures = new Map();
function picture(path) {
  if (!pictures.has(path)) {
    const uri = ask(path, { accept: "image/jpeg" }).then(async (answer) => URL.createObjectURL(await answer.blob()), () => null);
    pictures.set(path, uri);
    if (pictures.size > 400) pictures.delete(pictures.keys().next().value);
  }
  return pictures.get(path);
}

// The small picture of one of a map's images, or of another `kind` of it.
export function Thumbnail({ domain, version, kind = "map-images", number, alt, isKept }) {
  const path = isKept && `v1/domains/${domain}/${kind}/${number}/thumbnail?map_version=${version}`;
  const [uri, setUri] = useState(undefined);
  useEffect(() => {
    if (!path) return undefined;
    let isOver = false;
    picture(path).then((found) => isOver || setUri(found));
    return () => {
      isOver = true;
    };
  }, [path]);
  if (!uri) return html`<p class="gone">${path && uri === undefined ? "" : "no picture kept"}</p>`;
  return html`<img src=${uri} alt=${alt} loading="lazy" />`;
}
