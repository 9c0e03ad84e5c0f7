// A folder of images becomes a traverse, frame by frame, and goes on where it stopped; then a map.

import { html, useEffect, useRef, useState } from "./preact.js";
import { ask, json } from "./http.js";
import { Fault, Loading, metres, percent, span, useAnswer } from "./parts.js";

const AT_ONCE = 4;
const REFUSALS = [413, 415, 422]; // of one image: the drive goes on without it
const inOrder = new Intl.Collator("en", { numeric: true }).compare;

// positions.csv as recordings have it: a header, a name, metres.
export function positionsOf(text, names) {
  const lines = text.replace(/^\ufeff/, "").split(/\r?\n/).filter((line) => line.trim());
  const separator = lines[0]?.includes(";") ? ";" : ",";
  const header = lines[0].split(separator).map((cell) => cell.trim().toLowerCase());
  const [name_at, position_at] = [header.findIndex((cell) => ["name", "file", "filename", "image", "frame"].includes(cell)), header.findIndex((cell) => ["position_m", "position", "route_position_m"].includes(cell))];
  if (position_at < 0) throw new Error("positions.csv has no column position_m. The command deepsimbad-client upload also reads x and y, GPS and times.");
  const by_name = new Map();
  lines.slice(1).forEach((line, row) => {
    const cells = line.split(separator).map((cell) => cell.trim());
    const at_m = Number(separator === ";" ? cells[position_at].replace(",", ".") : cells[position_at]);
    if (cells[position_at] && Number.isFinite(at_m)) by_name.set(name_at < 0 ? names[row] : cells[name_at].split(/[\\/]/).pop().toLowerCase(), at_m);
  });
  return (name) => by_name.get(name_at < 0 ? name : name.toLowerCase());
}

export function Upload({ names: [domain] }) {
  const traverses = useAnswer(`v1/admin/domains/${domain}/traverses?limit=1000`);
  const [frames, setFrames] = useState(null);
  const [leftOut, setLeftOut] = useState([]);
  const [spacing_m, setSpacing] = useState("1");
  const [name, setName] = useState("");
  const [done, setDone] = useState(null);
  const [problem, setProblem] = useState(null);
  const [refused, setRefused] = useState([]); // images that the service does not take, and why
  const [isBusy, setBusy] = useState(false);
  const stop = useRef(null);
  useEffect(() => () => stop.current?.abort(), []);
  const choose = async (event) => {
    const files = [...event.target.files];
    const images = files.filter((file) => /\.(jpe?g|png|tiff?|webp)$/i.test(file.name)).sort((a, b) => inOrder(a.name, b.name));
    const csv = files.find((file) => file.name.toLowerCase() === "positions.csv");
    setProblem(null);
    try {
      const position = csv ? positionsOf(await csv.text(), images.map((file) => file.name)) : null;
      const placed = images.map((file, row) => ({ file, at_m: position ? position(file.name) : row })).filter((frame) => frame.at_m !== undefined);
      setLeftOut(images.filter((file) => position && position(file.name) === undefined).map((file) => file.name));
      setFrames({ list: placed, isSpaced: !position });
      if (!name && images.length) setName((images[0].webkitRelativePath.split("/")[0] || "drive").replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[^A-Za-z0-9]+/, "").slice(0, 64));
    } catch (fault) {
      setProblem(fault);
      setFrames(null);
    }
  };
  const upload = async (event) => {
    event.preventDefault();
    stop.current = new AbortController();
    const { signal } = stop.current;
    const base = `v1/admin/domains/${domain}/traverses`;
    setProblem(null);
    setRefused([]);
    setBusy(true);
    try {
      await json(base, { method: "POST", body: { name } }).catch((fault) => {
        if (fault.status !== 409) throw fault; // it is gone on with
      });
      const stored = await json(`${base}/${name}`, { signal });
      const missing = stored.missing.flatMap(([from, to]) => Array.from({ length: to - from + 1 }, (_, i) => from + i)); // what a cut left
      const last = stored.n_frames + missing.length; // frames from here on were never sent
      const wanted = frames.list.map((frame, index) => ({ ...frame, index })).filter(({ index }) => index >= last || missing.includes(index));
      const scale = frames.isSpaced ? Number(spacing_m) : 1;
      const [began, n_before] = [performance.now(), frames.list.length - wanted.length];
      let [n_sent, next] = [0, 0];
      setDone({ n: n_before, left_s: null });
      const send = async () => {
        while (next < wanted.length && !signal.aborted) {
          const { file, at_m, index } = wanted[next];
          next += 1;
          const query = `position_m=${at_m * scale}&name=${encodeURIComponent(file.name)}&replace=false`;
          try {
            await ask(`${base}/${name}/frames/${index}?${query}`, { method: "PUT", body: file, type: file.type || "image/jpeg", signal });
          } catch (fault) {
            if (!REFUSALS.includes(fault.status)) throw fault;
            setRefused((before) => [...before, `${file.name}: ${fault.message}`]);
          }
          n_sent += 1;
          setDone({ n: n_before + n_sent, left_s: (((performance.now() - began) / n_sent) * (wanted.length - n_sent)) / 1000 });
        }
      };
      await Promise.all(Array.from({ length: AT_ONCE }, send));
      traverses.again();
    } catch (fault) {
      stop.current?.abort();
      if (fault.name !== "AbortError") setProblem(fault);
    }
    setBusy(false);
  };
  if (traverses.problem?.status === 404) return html`<div class="head"><h1>Upload</h1></div><${Fault} problem=${traverses.problem} />`;
  return html`<div class="head"><h1>Upload to <a href=${`#domains/${domain}`}>${domain}</a></h1></div>
    <${Fault} problem=${problem} /><${Fault} problem=${traverses.problem} />
    <div class="columns"><div class="stack"><section class="card"><h2>A recorded drive</h2>
      <p>A folder of images in the order of their names, with a <code>positions.csv</code> (<code>name,position_m</code>) where there is one. Cut off, it goes on where it stopped: choose the same folder again.</p>
      <form onSubmit=${upload}>
        <label>Folder <input type="file" webkitdirectory multiple onChange=${choose} disabled=${isBusy} /></label>
        ${frames && html`<p><b>${frames.list.length.toLocaleString()} images</b>${leftOut.length ? html`, <span class="badge so">${leftOut.length} without a position left out</span>: ${leftOut.slice(0, 3).join(", ")}${leftOut.length > 3 ? ", …" : ""}` : ""}</p>`}
        <div class="row below"><label>Traverse <input type="text" value=${name} pattern="[A-Za-z0-9][A-Za-z0-9._\\-]*" maxlength="64" required onInput=${(event) => setName(event.target.value)} disabled=${isBusy} /></label>
        ${frames?.isSpaced && html`<label>Metres between images <input type="number" min="0.01" step="any" value=${spacing_m} required onInput=${(event) => setSpacing(event.target.value)} disabled=${isBusy} /></label>`}
        <button class="first" disabled=${!frames?.list.length || isBusy}>${done && !isBusy && done.n < frames?.list.length ? "Go on" : "Upload"}</button>
        ${isBusy && html`<button type="button" onClick=${() => stop.current?.abort()}>Pause</button>`}</div>
      </form>
      ${done && html`<div class="below"></div><progress max=${frames.list.length} value=${done.n} aria-label="Uploaded"></progress>
        <p class="number" role="status">${done.n.toLocaleString()} of ${frames.list.length.toLocaleString()} images (${percent(done.n / frames.list.length)})${isBusy && done.left_s !== null ? `, about ${span(done.left_s)} left` : ""}</p>`}
      ${refused.length > 0 && html`<div class="notice so" role="status"><b>${refused.length} refused, the others are taken</b><ul>${refused.slice(0, 5).map((line) => html`<li>${line}</li>`)}${refused.length > 5 && html`<li>…</li>`}</ul></div>`}
    </section></div>
    <div class="stack"><${Remap} domain=${domain} traverses=${traverses.answer?.traverses} /></div></div>`;
}

function Remap({ domain, traverses }) {
  const [problem, setProblem] = useState(null);
  if (!traverses) return html`<${Loading} what="traverses" />`;
  const submit = async (event) => {
    event.preventDefault();
    const fields = event.target.elements;
    const body = { training_traverse: fields.training.value, activate: fields.activate.checked };
    if (fields.landmarks.value) body.landmark_traverse = fields.landmarks.value;
    try {
      const job = await json(`v1/admin/domains/${domain}/remaps`, { method: "POST", body });
      location.hash = `jobs/${job.job_id}`;
    } catch (fault) {
      setProblem(fault);
    }
  };
  const options = traverses.map((traverse) => html`<option value=${traverse.name}>${traverse.name} (${traverse.n_frames} frames${traverse.length_m ? `, ${metres(traverse.length_m, 0)}` : ""})</option>`);
  return html`<section class="card"><h2>Make a map</h2><${Fault} problem=${problem} />
    ${traverses.length === 0 ? html`<p class="quiet">Of a traverse, once one is here.</p>` : html`<form class="stack" onSubmit=${submit}>
      <label>Drive that becomes the map <select name="training">${options}</select></label>
      <label>Another season of the same route, where there is one <select name="landmarks"><option value="">none</option>${options}</select></label>
      <span><input type="checkbox" name="activate" id="activate" checked /> <label for="activate" class="inline">Activate it when it is whole</label></span>
      <div class="row"><button class="first">Remap</button></div></form>`}
  </section>`;
}
