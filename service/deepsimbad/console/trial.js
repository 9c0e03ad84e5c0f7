// One image tried: where it places a robot; and an episode, view by view, for people who want to see how it works.

import { html, useEffect, useRef, useState } from "./preact.js";
import { json } from "./http.js";
import { useRoute } from "./domains.js";
import { Believed, Figures, NextMove, Places } from "./answer.js";
import { Fault, Loading, metres, useAnswer, useDropped } from "./parts.js";

export function Trial({ names: [given] }) {
  const { answer, problem } = useAnswer("v1/domains");
  const mapped = answer?.domains.filter((domain) => domain.map_version !== null) ?? [];
  const name = given ?? mapped[0]?.name;
  if (!answer) return problem ? html`<${Fault} problem=${problem} />` : html`<${Loading} what="domains" />`;
  if (!name) return html`<div class="head"><h1>Try it</h1></div><div class="card empty"><h2>Nothing is mapped yet</h2><p><a href="#">Domains</a> says how.</p></div>`;
  return html`<div class="head"><h1>Try it</h1>
      <label class="row">Domain <select onChange=${(event) => { location.hash = `try/${event.target.value}`; }}>${mapped.map((domain) => html`<option value=${domain.name} selected=${domain.name === name}>${domain.name}</option>`)}</select></label></div>
    <${On} key=${name} name=${name} />`;
}

function On({ name }) {
  const { domain, coverage, route } = useRoute(name);
  const [view, setView] = useState(null);
  const [answer, setAnswer] = useState(null);
  const [episode, setEpisode] = useState(null); // the session of a step-through
  const [moved_m, setMoved] = useState("");
  const [problem, setProblem] = useState(null);
  const [isBusy, setBusy] = useState(false);
  const session = useRef(null);
  const over = () => {
    if (session.current) json(`v1/sessions/${session.current}`, { method: "DELETE" }).catch(() => {});
    session.current = null;
  };
  useEffect(() => over, []);
  const run = async (work) => {
    setBusy(true);
    try {
      await work();
      setProblem(null);
    } catch (fault) {
      setProblem(fault);
    }
    setBusy(false);
  };
  const look = (file) =>
    run(async () => {
      const options = { method: "POST", body: file, type: file.type || "image/jpeg" };
      const path = session.current ? `v1/sessions/${session.current}/observations?action_m=${Number(moved_m) || 0}` : `v1/domains/${name}/localizations`;
      const now = await json(path, options);
      setView((before) => {
        if (before) URL.revokeObjectURL(before);
        return URL.createObjectURL(file);
      });
      setAnswer(now);
      setMoved(String(now.next_best_view?.action_m ?? ""));
    });
  const begin = () =>
    run(async () => {
      over();
      const begun = await json(`v1/domains/${name}/sessions`, { method: "POST", body: {} });
      session.current = begun.session_id;
      setEpisode(begun.session_id);
      setAnswer(begun);
      setView(null);
    });
  const end = () => {
    over();
    setEpisode(null);
    setAnswer(null);
    setView(null);
  };
  return html`<section class="card">
      <${Drop} onFile=${look} isBusy=${isBusy} text=${episode ? "Drop the next view here" : "Drop an image of the route here"} />
      <div class="row below">
        ${episode
          ? html`<label>Metres driven since the last view <input type="number" step="any" value=${moved_m} onInput=${(event) => setMoved(event.target.value)} /></label>
              <button onClick=${end}>End the episode</button><a href=${`#sessions/${episode}`} target="_blank">Its history</a>`
          : html`<button onClick=${begin} disabled=${isBusy}>Go through an episode, view by view</button>`}
      </div>
    </section>
    ${episode && html`<${Explained} answer=${answer} />`}
    <div class="below"></div><${Fault} problem=${problem} />
    ${answer && html`<div class="columns below"><div class="stack"><${Believed} answer=${answer} route=${route} title=${episode ? `After ${answer.n_observations} view${answer.n_observations === 1 ? "" : "s"}` : "After this one view"} />
        <${Places} answer=${answer} domain=${name} version=${answer.map_version ?? domain.answer?.map_version} view=${view} isKept=${coverage.answer?.thumbnail_bytes > 0} /></div>
      <div class="stack"><${Figures} answer=${answer} /><${NextMove} next=${answer.next_best_view} /></div></div>`}`;
}

// What has just happened, in the method's own order.
function Explained({ answer }) {
  const n = answer?.n_observations ?? 0;
  const best = answer?.retrieval?.[0];
  return html`<ol class="card below">
    <li><b>Describe.</b> ${n === 0 ? "A view is encoded and compared with the map's landmarks." : "The view was encoded and compared with the map's landmarks."}</li>
    <li><b>Retrieve.</b> ${best ? `The map image at ${metres(best.route_position_m)} is most like it.` : "Every map image lists a few landmarks; those whose landmarks the view is near to are relevant."}</li>
    <li><b>Predict.</b> The belief moves on by the metres driven, and widens by their error.</li>
    <li><b>Update.</b> ${n === 0 ? "Nothing is known yet: every place is as likely." : `What the view says is multiplied in: ${answer.belief.entropy_bits.toFixed(1)} bits are still unknown.`}</li>
    <li><b>Plan.</b> ${answer?.next_best_view ? (answer.next_best_view.stop ? "It is sure: no move would tell more." : `The view ${metres(answer.next_best_view.action_m)} on would tell most. Drive there, and drop the image seen from there.`) : "The map names no move."}</li>
  </ol>`;
}

function Drop({ onFile, isBusy, text }) {
  const [isOver, setOver] = useState(false);
  const take = (files) => files.length && !isBusy && onFile(files[0]);
  useDropped((files) => {
    setOver(false);
    take(files);
  });
  return html`<div class=${`drop ${isOver ? "over" : ""}`}
    onDragOver=${() => setOver(true)} onDragLeave=${() => setOver(false)}>
    <p><b>${text}</b></p>
    <label>or choose a file <input type="file" accept="image/*" disabled=${isBusy} onChange=${(event) => { take(event.target.files); event.target.value = ""; }} /></label>
    ${isBusy && html`<p role="status">Looking …</p>`}
  </div>`;
}
