// An answer to a view, of a session or of a single image: what is believed, what to do next, what the view looks like.

import { html } from "./preact.js";
import { Route, RouteMap, Strip } from "./charts.js";
import { Frame, Thumbnail, metres, percent } from "./parts.js";

// How wide the credible set is, all its pieces together.
function credible_m(belief) {
  const { edges_m } = belief.histogram;
  const length_m = edges_m[edges_m.length - 1] - edges_m[0];
  return belief.credible_95_sets_m.reduce((sum, [from_m, to_m]) => sum + (to_m >= from_m ? to_m - from_m : length_m + to_m - from_m), 0);
}

export function Believed({ answer, route, title, children }) {
  const { belief, next_best_view: next } = answer;
  const set_m = credible_m(belief);
  const words = `${title}: most probably at ${metres(belief.mode_m)}; 95 % of the belief lies on ${metres(set_m)} of the route.`;
  return html`<section class="card"><header><h2>${title}</h2>
      <span class="legend"><span><i class="swatch belief"></i>belief</span><span><i class="swatch credible"></i>95 % set</span>${next && html`<span><i class="swatch move"></i>after ${next.stop ? "a" : "the best"} move</span>`}</span></header>
    ${route && html`<${RouteMap} route=${route} belief=${belief} next=${next} label=${words} />`}
    <${Strip} belief=${belief} next=${next} route=${route ?? bare(belief)} label=${`The belief along the route. ${words}`} />
    ${children}
  </section>`;
}

// A route of which no more is known than its ends.
function bare(belief) {
  const { edges_m } = belief.histogram;
  return new Route({ route_position_m: [edges_m[0], edges_m[edges_m.length - 1]] });
}

export function Figures({ answer }) {
  const { belief } = answer;
  const is_lost = belief.off_route > 0.5;
  return html`<section class="card"><header><h2>Where it is</h2>
      ${is_lost ? html`<span class="badge bad">probably off the route</span>` : belief.confident ? html`<span class="badge good">confident</span>` : html`<span class="badge so">not sure yet</span>`}</header>
    <dl class="figures">
      <div><dt>Likeliest place</dt><dd>${metres(belief.mode_m)}</dd></div>
      <div><dt>95 % set</dt><dd>${metres(credible_m(belief))} <small>in ${belief.credible_95_sets_m.length} piece${belief.credible_95_sets_m.length === 1 ? "" : "s"}</small></dd></div>
      <div><dt>Standard deviation</dt><dd>${metres(belief.std_m)}</dd></div>
      <div><dt>Entropy</dt><dd>${belief.entropy_bits.toFixed(1)} <small>bits</small></dd></div>
      <div><dt>Off the route</dt><dd>${percent(belief.off_route, belief.off_route < 0.1 ? 1 : 0)}</dd></div>
      <div><dt>The view</dt><dd>${answer.informative === undefined ? "–" : answer.informative ? "informative" : "told nothing"}</dd></div>
    </dl>
    ${answer.warnings?.map((warning) => html`<p class="notice so">${warning}</p>`)}
  </section>`;
}

export function NextMove({ next }) {
  if (!next) return html`<section class="card"><h2>Next best view</h2><p class="quiet">The map names no move: it was made with none to plan.</p></section>`;
  const hasBits = next.actions.some((action) => action.expected_bits !== null);
  const value = (action) => action.q_value ?? action.expected_bits ?? 0;
  const [least, most] = [Math.min(...next.actions.map(value)), Math.max(...next.actions.map(value))];
  const isChosen = (action) => action.action_m === next.action_m && !next.stop;
  const share = (action) => 0.04 + (0.96 * (value(action) - least)) / (most - least || 1);
  return html`<section class="card"><header><h2>Next best view</h2><span class="quiet">${next.planner}</span></header>
    <p class="advice">${next.stop ? "Stop: it knows where it is" : next.action_m < 0 ? `Drive back ${metres(-next.action_m)}` : next.action_m === 0 ? "Stay and look again" : `Drive on ${metres(next.action_m)}`}</p>
    <ul class="moves" aria-label="What each move is worth">${next.actions.map((action) => html`<li>
      <span class=${`number ${isChosen(action) ? "chosen" : ""}`}>${metres(action.action_m)}${isChosen(action) ? html`<span class="hidden-text"> chosen</span>` : ""}</span>
      <span class=${`track ${isChosen(action) ? "chosen" : ""}`}><span class="fill" style=${{ width: `${100 * share(action)}%` }}></span></span>
      <span class="number">${hasBits ? html`${action.expected_bits.toFixed(2)} <small>bits</small>` : value(action).toFixed(2)}</span></li>`)}</ul>
    <p class="quiet"><small>${hasBits ? "Bars: what a move is worth, all views after it counted. Bits: what the view right after it should tell." : "Bars: what a move is worth, all views after it counted."}</small></p>
  </section>`;
}

export function Places({ answer, domain, version, view, isKept }) {
  const shown = answer.retrieval?.length ? answer.retrieval : answer.belief.top;
  const of_view = answer.retrieval?.length > 0;
  return html`<section class="card"><h2>${of_view ? "Places most like the view" : "Likeliest places"}</h2>
    <div class=${view ? "beside" : ""}>${view && html`<figure class="view"><img src=${view} alt="The view" /><figcaption class="quiet">The view</figcaption></figure>`}
    <ol class="places">${shown.slice(0, 6).map((place) => html`<li>
      <${Thumbnail} domain=${domain} version=${version} isKept=${isKept} number=${place.map_image} alt=${`Map image at ${metres(place.route_position_m)}`} />
      <div><b>${metres(place.route_position_m)}</b><small class="number">${of_view ? `relevance ${place.relevance.toFixed(2)}` : `${percent(place.mass, 1)} of the belief`}</small>
      <${Frame} name=${place.frame ?? `map image ${place.map_image}`} /></div></li>`)}</ol></div>
  </section>`;
}
