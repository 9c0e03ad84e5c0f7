// The frame of all pages: where somebody is, the key, and which page the address names.

import { html, render, useEffect, useRef, useState } from "./preact.js";
import { key } from "./http.js";
import { Domain, Domains } from "./domains.js";
import { Job, Jobs } from "./jobs.js";
import { Session, Sessions } from "./sessions.js";
import { Trial } from "./trial.js";
import { Upload } from "./upload.js";
import { useDropped } from "./parts.js";

const PAGES = [
  [/^$/, Domains],
  [/^domains\/([^/]+)$/, Domain],
  [/^domains\/([^/]+)\/upload$/, Upload],
  [/^sessions$/, Sessions],
  [/^sessions\/([^/]+)$/, Session],
  [/^try(?:\/([^/]+))?$/, Trial],
  [/^jobs$/, Jobs],
  [/^jobs\/([^/]+)$/, Job],
  [/^report$/, Report],
];
// A part of an address as it was meant; one that is none stays as it is.
function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

const LINKS = [["", "Domains"], ["sessions", "Sessions"], ["try", "Try it"], ["jobs", "Jobs"], ["report", "Reports"]];

function Report() {
  const [{ n_opened, file }, setOpened] = useState({ n_opened: 0, file: null });
  const given = useRef(null);
  const open = (next) => setOpened((before) => ({ n_opened: before.n_opened + 1, file: next }));
  useDropped((files) => open(files[0]));
  const loaded = (event) => {
    if (!file || given.current === n_opened) return; // a report that is written there loads, too
    given.current = n_opened;
    event.target.contentWindow.postMessage(file, "*"); // its origin is nobody's: it cannot be named
  };
  return html`<div class="head"><h1>Reports</h1><button onClick=${() => open(null)}>Open another</button></div>
    <p>The page that <code>deepsimbad try</code>, <code>deepsimbad experiment paper</code> or <code>deepsimbad-client replay</code> wrote: the
    file <code>index.html</code> of its folder, chosen below or dropped anywhere on this page. It is shown in a frame that reaches neither this page, nor your key, nor any host; it is not uploaded.</p>
    <iframe key=${n_opened} src="console/report.html" title="The report" onLoad=${loaded} sandbox="allow-scripts"></iframe>`;
}

function Missing() {
  return html`<div class="empty"><h1>There is no such page</h1><p><a href="#">All domains</a></p></div>`;
}

function KeyDialog({ onClose }) {
  const ref = useRef();
  useEffect(() => ref.current.showModal(), []);
  const keep = (event) => {
    event.preventDefault();
    key.set(event.target.elements.key.value.trim());
    ref.current.close("kept");
  };
  return html`<dialog ref=${ref} onClose=${() => onClose(ref.current.returnValue === "kept")} aria-labelledby="key-title">
    <h2 id="key-title">API key</h2>
    <p>Made by <code>deepsimbad keys create --scope admin</code>. It stays in this tab, and is forgotten with it.</p>
    <form onSubmit=${keep}>
      <label>Key <input type="password" name="key" autocomplete="off" value=${key.get()} autofocus /></label>
      <div class="row"><button type="button" onClick=${() => ref.current.close()}>Cancel</button><button class="first">Use it</button></div>
    </form>
  </dialog>`;
}

function Frame() {
  const here = () => location.hash.replace(/^#\/?/, "").replace(/\/$/, "");
  const [at, setAt] = useState(here());
  const [isAsking, setAsking] = useState(false);
  const [generation, setGeneration] = useState(0);
  const main = useRef();
  useEffect(() => {
    const moved = () => {
      setAt(here());
      scrollTo(0, 0);
      main.current?.focus({ preventScroll: true });
    };
    addEventListener("hashchange", moved);
    return () => removeEventListener("hashchange", moved);
  }, []);
  const path = at.split("?")[0];
  const [pattern, Page] = PAGES.find(([each]) => each.test(path)) ?? [/.*/, Missing];
  const names = (pattern.exec(path) ?? []).slice(1).map((name) => name && decoded(name));
  useEffect(() => {
    document.title = path ? `${path.split("/").map(decoded).join(" · ")} – Deep SIMBAD` : "Deep SIMBAD";
  }, [path]);
  const section = path.startsWith("domains/") ? "" : path.split("/")[0];
  const closed = (isKept) => {
    setAsking(false);
    if (isKept) setGeneration((n) => n + 1); // everything is asked anew, with the key there is now
  };
  return html`<a class="skip" href="#main" onClick=${(event) => { event.preventDefault(); main.current.focus(); }}>Skip to the content</a>
    <header class="bar">
      <a class="name" href="#"><img src="console/icon.svg" alt="" />Deep SIMBAD</a>
      <nav aria-label="Pages">${LINKS.map(([link, text]) => html`<a href=${`#${link}`} aria-current=${section === link ? "page" : undefined}>${text}</a>`)}</nav>
      <button class="small" onClick=${() => setAsking(true)}>${key.get() ? "Key: in use" : "Enter a key"}</button>
    </header>
    <main id="main" ref=${main} tabindex="-1"><${Page} key=${`${path} ${generation}`} names=${names} /></main>
    ${isAsking && html`<${KeyDialog} onClose=${closed} />`}`;
}

render(html`<${Frame} />`, document.body);
