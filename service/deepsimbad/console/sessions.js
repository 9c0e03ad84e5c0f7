// Robots that are driving: all of them; one with its belief as it moves, and every step that led there.

import { html, useEffect, useMemo, useRef, useState } from "./preact.js";
import { ask, follow } from "./http.js";
import { History, Plot } from "./charts.js";
import { useRoute } from "./domains.js";
import { Believed, Figures, NextMove, Places } from "./answer.js";
import { Fault, More, Wide, span, useList, when } from "./parts.js";

const MOST_EVENTS = 2000; // kept of a long session, the newest
const FRAME_MS = 80; // at most so often is the page drawn anew

export function Sessions() {
  const list = useList("v1/admin/sessions", 2000);
  const { answer, problem } = list;
  const open = (event) => {
    event.preventDefault();
    location.hash = `sessions/${encodeURIComponent(event.target.elements.id.value.trim())}`;
  };
  return html`<div class="head"><h1>Sessions</h1></div>
    ${problem?.status === 403 ? html`<p class="quiet">All sessions are shown to keys of the scope admin; yours opens its own, by id.</p>` : html`<${Fault} problem=${problem} />`}
    ${answer?.sessions.length === 0 && html`<div class="card empty below"><h2>No robot is driving</h2>
      <p>A session begins when a robot, or a replay, asks for one:</p><pre>deepsimbad-client replay path/to/images --domain my-route</pre></div>`}
    ${answer?.sessions.length > 0 && html`<div class="card"><${Wide} label="Sessions"><table>
      <thead><tr><th>Session</th><th>Domain</th><th class="n">Map</th><th class="n">Views</th><th>Begun</th><th>Ends unless it moves</th></tr></thead>
      <tbody>${answer.sessions.map((session) => html`<tr>
        <td class="name"><a href=${`#sessions/${session.session_id}`}>${session.session_id}</a></td><td>${session.domain}</td><td class="n">${session.map_version}</td>
        <td class="n">${session.n_observations}</td><td>${when(session.created_at)}</td><td>in ${span((new Date(session.expires_at) - Date.now()) / 1000)}</td></tr>`)}</tbody></table><//><${More} list=${list} /></div>`}
    <form class="row below" onSubmit=${open}><label>A session by its id, also one that has ended <input type="text" name="id" required /></label><button>Open</button></form>`;
}

const WORDS = {
  connecting: ["plain", "connecting"], connected: ["good", "live"], lost: ["so", "connection lost, trying again"], ended: ["plain", "the session has ended"], refused: ["bad", "refused"],
};

// A session's events: the newest at once and as they come, those before it behind them; or as many before one of them.
function useEvents(id, before) {
  const live = useRef([]);
  const earlier = useRef([]);
  const older = useRef([]);
  const [, setDrawn] = useState(0);
  const [state, setState] = useState("connecting");
  const [problem, setProblem] = useState(null);
  useEffect(() => {
    const [stop, behind] = [new AbortController(), new AbortController()];
    const path = `v1/sessions/${encodeURIComponent(id)}/events`;
    let timer = 0;
    const drawSoon = () => {
      timer ||= setTimeout(() => {
        timer = 0;
        setDrawn((n) => n + 1);
      }, FRAME_MS);
    };
    const fetchEarlier = (first) =>
      follow(path, {
        signal: behind.signal,
        after: Math.max(0, first - MOST_EVENTS),
        onEvent: (name, answer, number) => {
          if (name !== "done" && number < first) earlier.current.push({ number, name, answer });
          if (name === "done" || number >= first - 1) behind.abort();
          drawSoon();
        },
      });
    follow(path, {
      signal: stop.signal,
      onEvent: (name, answer, number) => {
        if (name === "done") return;
        live.current.push({ number, name, answer });
        if (live.current.length === 1 && number > 1) fetchEarlier(number);
        if (live.current.length > MOST_EVENTS) live.current.shift();
        while (earlier.current.length && live.current.length + earlier.current.length > MOST_EVENTS) earlier.current.shift();
        drawSoon();
      },
      onState: (now, fault) => {
        setState(now);
        setProblem(fault ?? null);
      },
    });
    return () => {
      stop.abort();
      behind.abort();
      clearTimeout(timer);
    };
  }, [id]);
  useEffect(() => {
    older.current = [];
    if (before === null) return undefined;
    const stop = new AbortController();
    follow(`v1/sessions/${encodeURIComponent(id)}/events`, {
      signal: stop.signal,
      after: Math.max(0, before - 1 - MOST_EVENTS),
      onEvent: (name, answer, number) => {
        if (name !== "done" && number < before) older.current.push({ number, name, answer });
        if (name === "done" || number >= before - 1) stop.abort();
        setDrawn((n) => n + 1);
      },
    });
    return () => stop.abort();
  }, [id, before]);
  const newest = [...earlier.current, ...live.current];
  return { all: before !== null && older.current.length ? older.current : newest, newest, state, problem };
}

export function Session({ names: [id] }) {
  const [before, setBefore] = useState(null); // events before the one of this number are shown; null: the newest
  const { all, newest, state, problem } = useEvents(id, before);
  const [chosen, setChosen] = useState(null); // an event's number; null: the newest
  const found = chosen === null ? all.length - 1 : all.findIndex(({ number }) => number >= chosen);
  const at = found < 0 ? all.length - 1 : found;
  const isNewest = all.length === 0 || all[all.length - 1] === newest[newest.length - 1];
  const pick = (index) => {
    if (index < 0) {
      setBefore(all[0].number);
      setChosen(all[0].number - 1);
    } else if (index >= all.length && !isNewest) {
      const [end, first] = [all[all.length - 1].number + 1, newest[0].number];
      setBefore(end + MOST_EVENTS < first ? end + MOST_EVENTS : end < first ? first : null);
      setChosen(end);
    } else setChosen(isNewest && index >= all.length - 1 ? null : all[index].number);
  };
  const goLive = () => {
    setBefore(null);
    setChosen(null);
  };
  const event = all[at];
  const [tone, word] = WORDS[state];
  return html`<div class="head"><h1>Session</h1><code>${id}</code>
      ${event && html`<span>on <a href=${`#domains/${event.answer.domain}`}>${event.answer.domain}</a>, map ${event.answer.map_version}</span>`}
      <span class=${`badge ${tone}`} role="status">${word}</span></div>
    <${Fault} problem=${problem} />
    ${!event && !problem && (state === "ended" ? html`<p class="quiet">It ended before any view.</p>` : html`<p class="quiet" role="status">Waiting for its first view …</p>`)}
    ${event && html`<${Steps} all=${all} at=${at} isLive=${chosen === null} isNewest=${isNewest} onPick=${pick} onLive=${goLive} state=${state} /><${Live} events=${all} at=${at} isNewest=${isNewest && at === all.length - 1} onPick=${pick} />`}`;
}

function Steps({ all, at, isLive, isNewest, onPick, onLive, state }) {
  const { number, name, answer } = all[at];
  return html`<section class="card" aria-label="Steps"><div class="steps">
    <span class="row"><button class="small" aria-label="One step back" disabled=${all[at].number === 1} onClick=${() => onPick(at - 1)}>←</button>
      <button class="small" aria-label="One step on" disabled=${isNewest && at === all.length - 1} onClick=${() => onPick(at + 1)}>→</button></span>
    <input type="range" min="0" max=${Math.max(all.length - 1, 1)} value=${at} aria-label="Step shown" aria-valuetext=${`event ${number}`} onInput=${(event) => onPick(Number(event.target.value))} />
    <span class="number">${name === "prior" ? `told its place, event ${number}` : `view ${answer.n_observations}`}</span>
    <button class="small" disabled=${isLive} onClick=${onLive}>${state === "ended" ? "Last step" : "Follow live"}</button>
  </div>${all[0].number > 1 && html`<p class="quiet"><small>Events ${all[0].number.toLocaleString()} to ${all[all.length - 1].number.toLocaleString()}. <button class="link" onClick=${() => onPick(-1)}>Those before</button></small></p>`}</section>`;
}

function Live({ events, at, isNewest, onPick }) {
  const { answer } = events[at];
  const { route, coverage } = useRoute(answer.domain, answer.map_version);
  const view = useView(answer.session_id, isNewest ? answer.n_observations : null);
  const steps = useMemo(() => {
    const numbers = events.map((event) => event.number);
    return [numbers, events.map((event) => event.answer.belief.entropy_bits), events.map((event) => 100 * event.answer.belief.off_route)];
  }, [events.length, events[0]?.number]);
  const title = `After ${answer.n_observations} view${answer.n_observations === 1 ? "" : "s"}`;
  return html`<div class="columns below"><div class="stack">
      <${Believed} answer=${answer} route=${route} title=${title}>
        <h3>How it came about</h3><p class="quiet"><small>The belief along the route, a row a step, newest below; choose one to go there.</small></p>
        <${History} events=${events} current=${at} onPick=${onPick} label="The belief along the route after every step" />
      <//>
      <${Places} answer=${answer} domain=${answer.domain} version=${answer.map_version} view=${view} isKept=${coverage.answer?.thumbnail_bytes > 0} />
    </div><div class="stack">
      <${Figures} answer=${answer} /><${NextMove} next=${answer.next_best_view} />
      <section class="card"><header><h2>Entropy and the chance to be lost</h2><span class="legend"><span><i class="swatch belief"></i>entropy, bits</span><span><i class="swatch lost"></i>off the route, %</span></span></header>
        <${Plot} label=${`Entropy now ${answer.belief.entropy_bits.toFixed(1)} bits`} values=${steps} height=${140}
          series=${[{ stroke: "blue", scale: "y" }, { stroke: "mark", scale: "lost", dash: [6, 4] }]}
          scales=${{ x: { time: false }, y: { range: (_, __, most) => [0, Math.max(1, most) * 1.05] }, lost: { range: [0, 100] } }}
          axes=${[{ label: "event", labelSize: 20, size: 36, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500] }, {}, { scale: "lost", side: 1, grid: { show: false }, values: (_, ticks) => ticks.map((tick) => `${tick} %`) }]} /></section>
    </div></div>`;
}

// What the robot saw last, where the service still holds it; asked for once at a time, and at last for the newest.
function useView(session_id, n_observations) {
  const [uri, setUri] = useState(null);
  const [n_asked, setAsked] = useState(0);
  const [isAsking, isLeft, isShown] = [useRef(false), useRef(false), useRef(false)];
  isShown.current = n_observations !== null;
  useEffect(() => {
    if (n_observations === null) return setUri(null);
    if (isAsking.current) {
      isLeft.current = true;
      return undefined;
    }
    isAsking.current = true;
    isLeft.current = false;
    ask(`v1/sessions/${session_id}/view`, { accept: "image/jpeg" })
      .then(async (answer) => {
        if (answer.status === 204 || !isShown.current) return setUri(null);
        const blob = await answer.blob();
        return setUri((before) => {
          if (before) URL.revokeObjectURL(before);
          return URL.createObjectURL(blob);
        });
      }, () => setUri(null))
      .finally(() => {
        isAsking.current = false;
        if (isLeft.current) setAsked((n) => n + 1);
      });
    return undefined;
  }, [session_id, n_observations, n_asked]);
  return uri;
}
