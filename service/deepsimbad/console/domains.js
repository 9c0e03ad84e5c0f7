// What is mapped: all domains; one with its route, how surely it is recognised, and its map versions.

import { html, useEffect, useMemo, useState } from "./preact.js";
import { json } from "./http.js";
import { Route, RouteMap } from "./charts.js";
import { Fault, Frame, Loading, More, Thumbnail, Wide, bytes, confirmed, metres, percent, useAnswer, useList, when } from "./parts.js";

const MOST_AT_A_GLANCE = 24;

export function Domains() {
  const { answer, problem } = useAnswer("v1/domains", 5000);
  const [wanted, setWanted] = useState("");
  const found = answer?.domains.filter((domain) => domain.name.toLowerCase().includes(wanted.trim().toLowerCase()));
  return html`<div class="head"><h1>Domains</h1>
      ${answer?.domains.length > MOST_AT_A_GLANCE && html`<label class="row">Find <input type="text" value=${wanted} onInput=${(event) => setWanted(event.target.value)} /></label>`}</div>
    <${Fault} problem=${problem} />
    ${!answer && !problem && html`<${Loading} what="domains" />`}
    ${answer?.domains.length === 0 && html`<div class="card empty"><h2>Nothing is mapped yet</h2>
      <p>Make a domain below and upload a folder of images to it, or map one beside the service:</p>
      <pre>deepsimbad map my-route --training path/to/images</pre></div>`}
    ${found?.length === 0 && answer.domains.length > 0 && html`<p class="quiet">None of ${answer.domains.length.toLocaleString()} is called so.</p>`}
    <div class="grid">${found?.map((domain) => html`<${Card} key=${domain.name} domain=${domain} />`)}</div>
    ${answer && html`<${New} isOpen=${answer.domains.length === 0} />`}`;
}

// A domain for images, by the service's default evaluator; other ones are made by the call.
function New({ isOpen }) {
  const [problem, setProblem] = useState(null);
  const make = async (event) => {
    event.preventDefault();
    const { name, pictures } = event.target.elements;
    try {
      await json(`v1/admin/domains/${name.value}`, { method: "PUT", body: { evaluator: { kind: "feature_l2" }, thumbnails: pictures.checked } });
      location.hash = `domains/${name.value}/upload`;
    } catch (fault) {
      setProblem(fault);
    }
  };
  return html`<details class="below" open=${isOpen}><summary>Make a domain</summary>
    <form class="card" onSubmit=${make}><${Fault} problem=${problem} />
      <div class="row"><label>Name: letters, digits, . _ - <input type="text" name="name" pattern="[A-Za-z0-9][A-Za-z0-9._\\-]*" maxlength="64" required /></label>
        <span><input type="checkbox" name="pictures" id="pictures" checked /> <label for="pictures" class="inline">Keep small pictures, to look at</label></span>
        <button class="first">Make it</button></div></form></details>`;
}

function Card({ domain }) {
  const state = domain.map_problem ?? domain.evaluator_problem;
  return html`<a class="card" href=${`#domains/${domain.name}`}>
    <header><h2>${domain.name}</h2>
      ${state ? html`<span class="badge bad">${state}</span>` : domain.map_version === null ? html`<span class="badge so">no map yet</span>` : html`<span class="badge good">map ${domain.map_version}</span>`}</header>
    ${domain.n_map_images === null ? html`<p class="quiet">${state ? "Its map cannot serve." : "It waits for a traverse and a remap."}</p>` : html`<dl class="figures">
      <div><dt>Route</dt><dd>${metres(domain.route_length_m, 0)}</dd></div>
      <div><dt>Map images</dt><dd>${domain.n_map_images.toLocaleString()}</dd></div>
      <div><dt>Index</dt><dd>${domain.index_bits_per_map_image.toFixed(1)} <small>bit/image</small></dd></div>
    </dl>`}
  </a>`;
}

// A domain with its route; what both sessions and trials draw on.
export function useRoute(name, version) {
  const domain = useAnswer(`v1/domains/${name}`);
  const coverage = useAnswer(domain.answer?.map_version ? `v1/domains/${name}/coverage${version ? `?map_version=${version}` : ""}` : null);
  const route = useMemo(() => coverage.answer && new Route({ ...coverage.answer, closed: domain.answer?.closed, length_m: domain.answer?.route_length_m }), [coverage.answer]);
  return { domain, coverage, route };
}

export function Domain({ names: [name] }) {
  const { domain, coverage, route } = useRoute(name);
  const maps = useList(`v1/admin/domains/${name}/maps`, 5000);
  const { answer } = domain;
  const active = maps.answer?.maps.find((map) => map.state === "active")?.version;
  useEffect(() => {
    if (answer && active !== undefined && active !== answer.map_version) domain.again(); // somebody else switched
  }, [active]);
  if (domain.problem?.status === 404) return html`<div class="head"><h1>${name}</h1></div><${Fault} problem=${domain.problem} />`;
  return html`<div class="head"><h1>${name}</h1>
      ${answer && html`<span class="quiet">${answer.evaluator.extractor === "none" ? "ready encodings" : (answer.evaluator.extractor ?? answer.evaluator.kind)}${answer.relevance ? `, ${answer.relevance}` : ""}${answer.closed ? ", closed route" : ""}</span>`}
      <span class="row">${answer?.map_version && html`<a class="button" href=${`#try/${name}`}>Try an image</a>`}<a class="button" href=${`#domains/${name}/upload`}>Upload a traverse</a></span></div>
    <${Fault} problem=${domain.problem} /><${Fault} problem=${coverage.problem} />
    ${answer?.map_version === null && html`<div class="card empty"><h2>No map yet</h2><p>Upload a traverse, then remap: the map made of it is activated when it is whole.</p></div>`}
    <div class="columns">
      <div class="stack">
        ${answer?.map_version && !route && !coverage.problem && html`<${Loading} what="the route" />`}
        ${route && html`<${Covered} name=${name} route=${route} coverage=${coverage.answer} domain=${answer} />`}
        <${Worst} name=${name} coverage=${coverage.answer} />
      </div>
      <div class="stack">
        ${answer?.map_version && html`<${Active} domain=${answer} thumbnail_bytes=${coverage.answer?.thumbnail_bytes} />`}
      </div>
    </div>
    <${Versions} name=${name} maps=${maps} onSwitch=${() => { maps.again(); domain.again(); coverage.again(); }} />
    ${answer?.map_version && html`<${Landmarks} key=${answer.map_version} name=${name} version=${answer.map_version} list_length=${answer.list_length} />`}`;
}

function Covered({ name, route, coverage, domain }) {
  if (!coverage.chance) return html`<section class="card"><h2>The route</h2><${RouteMap} route=${route} label=${`The route of ${name}`} />
    <p class="quiet">How surely its places are recognised is not known of this map: a new one will tell.</p></section>`;
  const mean = coverage.chance.reduce((sum, chance) => sum + chance, 0) / coverage.chance.length;
  const label = `The route of ${name}, ${metres(domain.route_length_m, 0)} long; a single view is placed rightly in ${percent(mean)} of places.`;
  return html`<section class="card"><header><h2>How surely a place is recognised</h2>
      <span class="legend"><span>rarely, thick <i class="swatch scale"></i> always, thin</span></span></header>
    <${RouteMap} route=${route} label=${label} />
    <p class="quiet">The chance that one view alone is placed within ${coverage.within_m} m: ${percent(mean)} on average.
    ${coverage.basis === "two_seasons" ? " Learnt from two seasons of this route." : " Guessed from how alike its places are: a second season of the route would tell."}</p>
  </section>`;
}

function Active({ domain, thumbnail_bytes }) {
  return html`<section class="card"><h2>Active map</h2><dl class="figures">
    <div><dt>Version</dt><dd>${domain.map_version}</dd></div>
    <div><dt>Route</dt><dd>${metres(domain.route_length_m, 0)}</dd></div>
    <div><dt>Map images</dt><dd>${domain.n_map_images?.toLocaleString()}</dd></div>
    <div><dt>Landmarks</dt><dd>${domain.n_landmarks} <small>${domain.list_length} an image</small></dd></div>
    <div><dt>Index</dt><dd>${domain.index_bits_per_map_image?.toFixed(1)} <small>bit/image</small></dd></div>
    <div><dt>Pictures kept</dt><dd>${thumbnail_bytes ? bytes(thumbnail_bytes) : "none"}</dd></div>
    <div><dt>Moves</dt><dd>${domain.actions_m[0]} … ${domain.actions_m[domain.actions_m.length - 1]} <small>m</small></dd></div>
  </dl></section>`;
}

function Worst({ name, coverage }) {
  if (!coverage?.chance) return null;
  return html`<section class="card"><h2>Worst stretches</h2>
    ${coverage.stretches.length === 0 && html`<p class="quiet">None stands out.</p>`}
    <ol class="places wider">${coverage.stretches.slice(0, 6).map((stretch) => html`<li>
      <${Thumbnail} domain=${name} version=${coverage.map_version} number=${stretch.worst_map_image} alt="" isKept=${coverage.thumbnail_bytes > 0} />
      <div><b>${metres(stretch.from_m, 0)} – ${metres(stretch.to_m, 0)}</b><br />${percent(stretch.chance)} placed rightly<br />
        ${["worst", "first", "last"].map((which) => html`<${Frame} before=${`${which} `} name=${stretch[`${which}_frame`] ?? `map image ${stretch[`${which}_map_image`]}`} />`)}</div>
    </li>`)}</ol></section>`;
}

const LANDMARKS_AT_ONCE = 12;

// What the active map compares views with, those first that most places list.
function Landmarks({ name, version, list_length }) {
  const { answer, problem } = useAnswer(`v1/domains/${name}/landmarks?map_version=${version}`);
  const [n_shown, setShown] = useState(LANDMARKS_AT_ONCE);
  const order = useMemo(() => answer && answer.n_map_images.map((_, number) => number).sort((a, b) => answer.n_map_images[b] - answer.n_map_images[a]), [answer]);
  if (!answer) return html`<${Fault} problem=${problem} />`;
  const isKnown = answer.frame.some((frame) => frame !== null) || answer.map_image.some((image) => image !== null);
  const origin = isKnown ? "Each began as a frame of a drive." : answer.drive.some((drive) => drive !== null) ? "Each began as a frame that has no name." : "Which frames they began as is not known of this map: a new one will tell.";
  const n = order.length;
  return html`<section class="card below"><header><h2>Landmarks</h2><span class="quiet">${n.toLocaleString()}, most listed first</span></header>
    <p class="quiet">What views are compared with: every place of the route lists the ${list_length} that together are most like it. ${origin}</p>
    <ol class="places">${order.slice(0, n_shown).map((number) => html`<li key=${number}>
      ${isKnown && html`<${Thumbnail} domain=${name} version=${version} kind="landmarks" number=${number} alt="" isKept=${answer.thumbnail_bytes > 0} />`}
      <div><b>Landmark ${number}</b><small class="number">listed by ${answer.n_map_images[number].toLocaleString()} place${answer.n_map_images[number] === 1 ? "" : "s"}</small>
        ${isKnown && html`<${Frame} name=${answer.frame[number] ?? (answer.map_image[number] === null ? "a frame without a name" : `map image ${answer.map_image[number]}`)} />`}
        ${answer.drive[number] && html`<${Frame} before="of " name=${answer.drive[number]} />`}</div></li>`)}</ol>
    ${n_shown < n && html`<div class="row below"><button onClick=${() => setShown(n_shown + 4 * LANDMARKS_AT_ONCE)}>Show ${Math.min(4 * LANDMARKS_AT_ONCE, n - n_shown)} more</button></div>`}
  </section>`;
}

const FIGURES = [
  ["ANR of its check, %", (metrics) => metrics.check?.anr],
  ["ANR of the map before, %", (metrics) => metrics.check?.anr_active],
  ["Index, bit/image", (metrics) => metrics.index_bits_per_map_image],
];

function Versions({ name, maps, onSwitch }) {
  const [problem, setProblem] = useState(null);
  const [isBusy, setBusy] = useState(false);
  if (maps.problem && !maps.answer) return maps.problem.status === 403 || maps.problem.status === 401 ? html`<p class="quiet">Map versions are shown to keys of the scope admin.</p>` : html`<${Fault} problem=${maps.problem} />`;
  if (!maps.answer) return null;
  const list = maps.answer.maps;
  const active = list.find((map) => map.state === "active")?.version ?? null;
  const columns = FIGURES.filter(([, figure]) => list.some((map) => typeof figure(map.metrics) === "number"));
  const activate = async (map) => {
    const isBack = active !== null && map.version < active;
    const sure = await confirmed(
      `${isBack ? "Roll back" : "Switch"} ${name} to map ${map.version}?`,
      [
        `New sessions and single views are answered by map ${map.version} of ${when(map.created_at)} at once${active === null ? "" : `, no longer by map ${active}`}.`,
        "Sessions that run keep the map they began on. The same switch leads back.",
      ],
      isBack ? "Roll back" : "Activate",
    );
    if (!sure) return;
    setBusy(true);
    try {
      await json(`v1/admin/domains/${name}/active-map`, { method: "PUT", body: { version: map.version, expected: active } });
      setProblem(null);
    } catch (fault) {
      setProblem(fault);
    }
    setBusy(false);
    onSwitch();
  };
  return html`<section class="card below"><h2>Map versions</h2>
    <${Fault} problem=${problem} />
    ${list.length === 0 ? html`<p class="quiet">None yet.</p>` : html`<${Wide} label=${`Map versions of ${name}`}><table>
      <thead><tr><th>Version</th><th>State</th><th>Made</th><th class="n">Images</th><th>Relevance</th>${columns.map(([name]) => html`<th class="n">${name}</th>`)}</tr></thead>
      <tbody>${list.map((map) => html`<tr>
        <td><b>${map.version}</b></td>
        <td><span class="row"><span class=${`badge ${map.state === "active" ? "good" : "plain"}`}>${map.state}</span>
          ${map.version !== active && ["sealed", "retired"].includes(map.state) && html`<button class="small" disabled=${isBusy} onClick=${() => activate(map)}>${active !== null && map.version < active ? "Roll back" : "Activate"}</button>`}</span></td>
        <td>${when(map.created_at)}</td>
        <td class="n">${map.metrics.n_map_images?.toLocaleString() ?? "–"}</td>
        <td>${map.config.relevance ?? "–"}</td>
        ${columns.map(([, figure]) => html`<td class="n">${figure(map.metrics)?.toFixed(2) ?? "–"}</td>`)}
      </tr>`)}</tbody></table><//>`}
    <${More} list=${maps} />
  </section>`;
}
