// Work in the background: all jobs; one with its stage, how far it is, and how it ended.

import { html, useEffect, useState } from "./preact.js";
import { follow, json } from "./http.js";
import { Fault, Loading, More, Wide, confirmed, percent, span, useList, when } from "./parts.js";

const STAGES = ["read_frames", "fit", "describe", "train", "check"]; // in their order, as metrics name them
const ENDS = { succeeded: "Done", failed: "Failed", cancelled: "Cancelled" };
const titled = (word) => word[0].toUpperCase() + word.slice(1);
const TONES = { succeeded: "good", failed: "bad", cancelled: "plain", running: "so", queued: "plain" };

export function Jobs() {
  const list = useList("v1/admin/jobs", 1500);
  const { answer, problem } = list;
  return html`<div class="head"><h1>Jobs</h1></div>
    <${Fault} problem=${problem} />
    ${!answer && !problem && html`<${Loading} what="jobs" />`}
    ${answer?.jobs.length === 0 && html`<div class="card empty"><h2>No job yet</h2><p>A remap makes a map of an uploaded traverse: choose a <a href="#">domain</a>, and upload one.</p></div>`}
    ${answer?.jobs.length > 0 && html`<div class="card"><${Wide} label="Jobs"><table>
      <thead><tr><th>Job</th><th>Domain</th><th>State</th><th>Progress</th><th>Made</th></tr></thead>
      <tbody>${answer.jobs.map((job) => html`<tr><td class="name"><a href=${`#jobs/${job.job_id}`}>${job.kind} ${job.job_id.slice(0, 8)}</a></td>
        <td><a href=${`#domains/${job.domain}`}>${job.domain}</a></td><td><span class=${`badge ${TONES[job.state]}`}>${job.state}</span></td>
        <td>${job.state === "running" ? html`<progress max="1" value=${job.progress} aria-label="Progress"></progress> <small>${job.stage}</small>` : job.result ? `map ${job.result.map_version}` : job.error?.code ?? ""}</td>
        <td>${when(job.created_at)}</td></tr>`)}</tbody></table><//><${More} list=${list} /></div>`}`;
}

export function Job({ names: [id] }) {
  const [job, setJob] = useState(null);
  const [stages, setStages] = useState([]); // as they were seen to begin
  const [state, setState] = useState("connecting");
  const [problem, setProblem] = useState(null);
  useEffect(() => {
    const stop = new AbortController();
    follow(`v1/admin/jobs/${id}/events`, {
      signal: stop.signal,
      onEvent: (name, now) => {
        setJob(now);
        setStages((before) => (now.state !== "running" || !now.stage || before.at(-1)?.stage === now.stage ? before : [...before, { stage: now.stage, at: new Date() }]));
      },
      onState: (now, fault) => {
        setState(now);
        setProblem(fault ?? null);
      },
    });
    return () => stop.abort();
  }, [id]);
  const cancel = async () => {
    if (!(await confirmed("Cancel this job?", ["What it has made so far is discarded; the active map stays as it is."], "Cancel the job"))) return;
    try {
      await json(`v1/admin/jobs/${id}`, { method: "DELETE" });
    } catch (fault) {
      setProblem(fault);
    }
  };
  const seconds = job?.result?.metrics.seconds; // every stage's, of a job that ended well
  const log = !job ? [] : [
    ["asked for", job.created_at],
    ["begun", job.started_at],
    ...(seconds
      ? STAGES.filter((stage) => stage in seconds).map((stage) => [stage, null, seconds[stage]])
      : stages.map(({ stage, at }) => [`${stage}, as seen here`, at])),
    [job.state, job.finished_at],
  ].filter(([, at, taken_s]) => at || taken_s !== undefined);
  const isOver = job && !["queued", "running"].includes(job.state);
  return html`<div class="head"><h1>${job ? titled(job.kind) : "Job"}</h1>${job && html`<a href=${`#domains/${job.domain}`}>${job.domain}</a>`}<code>${id}</code>
      ${job && html`<span class=${`badge ${TONES[job.state]}`} role="status">${job.state}</span>`}</div>
    <${Fault} problem=${problem} />
    ${state === "lost" && !isOver && html`<p class="notice so" role="status">The connection was lost; the job goes on. Trying again …</p>`}
    ${!job && !problem && html`<${Loading} what="the job" />`}
    ${job && html`<div class="columns"><div class="stack">
      <section class="card"><h2>${isOver ? ENDS[job.state] : (job.stage && titled(job.stage.replaceAll("_", " "))) ?? (job.state === "queued" ? "Waiting for its turn" : "Starting")}</h2>
        <progress max="1" value=${job.progress} aria-label="Progress"></progress>
        <p class="number">${percent(job.progress)}${!isOver && job.eta_s !== null ? `, about ${span(job.eta_s)} left` : ""}</p>
        ${job.error && html`<p class="notice bad"><b>${job.error.detail}</b> <code>${job.error.code}</code></p>`}
        ${job.result && html`<p>Map version ${job.result.map_version} ${job.result.active ? "answers now." : "is sealed, and not active."} <a href=${`#domains/${job.domain}`}>See it</a></p>`}
        ${!isOver && html`<button onClick=${cancel}>Cancel</button>`}</section>
      ${job.result && html`<section class="card"><h2>What was measured</h2><${Headline} metrics=${job.result.metrics} />
        <details><summary>All figures</summary><${Measured} values=${job.result.metrics} /></details></section>`}
    </div><div class="stack">
      <section class="card"><h2>Log</h2><ol class="log">${log.map(([line, at, taken_s]) => html`<li>
        <span>${line.replaceAll("_", " ")}</span><span class="quiet number">${at ? when(at, "medium") : `took ${taken_s < 10 ? `${taken_s.toFixed(1)} s` : span(taken_s)}`}</span></li>`)}</ol></section>
      <section class="card"><h2>Asked for</h2><${Measured} values=${job.config} /></section>
    </div></div>`}`;
}

function Headline({ metrics }) {
  const { check } = metrics;
  const figures = [
    ["Map images", metrics.n_map_images?.toLocaleString()],
    ["Landmarks", metrics.n_landmarks?.toLocaleString()],
    ["Index", metrics.index_bits_per_map_image && html`${metrics.index_bits_per_map_image.toFixed(1)} <small>bit/image</small>`],
    ["ANR of its check", typeof check?.anr === "number" && html`${check.anr.toFixed(2)} <small>%, 0 is perfect</small>`],
    ["The map before", typeof check?.anr_active === "number" && html`${check.anr_active.toFixed(2)} <small>%</small>`],
  ].filter(([, figure]) => figure);
  const season = metrics.second_season, warnings = metrics.warnings ?? [];
  const isTold = !season || season.accepted || warnings.some((warning) => warning.includes(season.why));
  const remarks = [...(isTold ? [] : [`It learnt nothing of a second season: ${season.why}.`]), ...warnings];
  return html`<dl class="figures">${figures.map(([name, figure]) => html`<div><dt>${name}</dt><dd>${figure}</dd></div>`)}</dl>${remarks.map((remark) => html`<p class="notice so">${remark}</p>`)}`;
}

// Named values, those of one part after another; curves and the like are left to the call.
function rows(values, prefix = "") {
  return Object.entries(values).flatMap(([name, value]) => {
    const full = `${prefix}${name.replaceAll("_", " ")}`;
    if (Array.isArray(value)) return value.length && value.every((each) => typeof each === "string") ? [[full, value.join("; ")]] : [];
    if (value !== null && typeof value === "object") return rows(value, `${full}, `);
    return value === null ? [] : [[full, value]];
  });
}

function Measured({ values }) {
  const text = (value) => (typeof value === "number" && !Number.isInteger(value) ? value.toPrecision(4) : typeof value === "boolean" ? (value ? "yes" : "no") : String(value));
  return html`<${Wide} label="Figures"><table><tbody>${rows(values).map(([name, value]) => html`<tr><th scope="row">${name}</th><td class="name">${text(value)}</td></tr>`)}</tbody></table><//>`;
}
