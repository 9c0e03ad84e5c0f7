// Asks the service this page came from, with the key that was typed in, which is forgotten with the tab.

const ROOT = new URL(".", document.baseURI);
const KEY = "deepsimbad.key";

export const key = {
  get: () => sessionStorage.getItem(KEY) ?? "",
  set: (text) => (text ? sessionStorage.setItem(KEY, text) : sessionStorage.removeItem(KEY)),
};

// What the service answered where it did not do what was asked: RFC 9457.
export class Problem extends Error {
  constructor(status, document) {
    super(document.detail ?? document.title ?? `status ${status}`);
    this.status = status;
    this.code = document.code ?? "";
    this.document = document;
  }
}

export async function ask(path, { method = "GET", body, type, accept = "application/json", signal, headers = {} } = {}) {
  const request = { method, signal, headers: { Accept: accept, ...headers }, cache: "no-store" };
  if (key.get()) request.headers["X-API-Key"] = key.get();
  if (body !== undefined) {
    const isBinary = body instanceof Blob || body instanceof ArrayBuffer || typeof body === "string";
    request.headers["Content-Type"] = type ?? (isBinary ? body.type : "application/json");
    request.body = isBinary ? body : JSON.stringify(body);
  }
  let answer;
  try {
    answer = await fetch(new URL(path, ROOT), request);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, { code: "no_connection", detail: "The service does not answer. Is it running, and is this computer online?" });
  }
  if (answer.ok) return answer;
  let document = {};
  try {
    document = await answer.json();
  } catch {
    document = { detail: `${answer.status} ${answer.statusText}` };
  }
  throw new Problem(answer.status, document);
}

export async function json(path, options) {
  const answer = await ask(path, options);
  return answer.status === 204 ? null : answer.json();
}

const SLICE_MS = 10;

// Server-sent events, by hand: the browser's own reader sends no key. Goes on after a cut, behind the last event.
export async function follow(path, { onEvent, onState = () => {}, signal, after }) {
  let last = after;
  let waits_ms = 500;
  let worked_since = performance.now();
  while (!signal.aborted) {
    try {
      const headers = last === undefined ? {} : { "Last-Event-ID": String(last) };
      const answer = await ask(path, { accept: "text/event-stream", signal, headers });
      onState("connected");
      waits_ms = 500;
      let text = "";
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        text += value;
        const blocks = text.split(/\r?\n\r?\n/);
        text = blocks.pop();
        for (const block of blocks) {
          if (performance.now() - worked_since > SLICE_MS) {
            await new Promise((resume) => setTimeout(resume)); // what came at once holds no page up
            worked_since = performance.now();
          }
          const event = { name: "message", id: undefined, data: "" };
          for (const line of block.split(/\r?\n/)) {
            const [, field, content] = /^([a-z]+): ?(.*)$/.exec(line) ?? [];
            if (field === "event") event.name = content;
            else if (field === "id") event.id = last = Number(content);
            else if (field === "data") event.data += content;
          }
          if (!event.data) continue;
          onEvent(event.name, JSON.parse(event.data), event.id);
          if (event.name === "done") return onState("ended");
        }
      }
    } catch (error) {
      if (error.name === "AbortError") return;
      if (error instanceof Problem && error.status !== 0 && error.status < 500 && error.status !== 429) {
        onState("refused", error);
        return;
      }
    }
    onState("lost");
    await new Promise((resume) => setTimeout(resume, waits_ms));
    waits_ms = Math.min(2 * waits_ms, 8000);
  }
}
