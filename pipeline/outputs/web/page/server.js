// The server: questions, requests and live events. The page comes back by itself when the server does.

export const PREFIX = "/api/v1";
const RETRY_MS = 1000;

export let me = { name: "", may_read: false, may_act: false, has_login: false, csrf_token: "" };

export class Refused extends Error {
  constructor(status, text) {
    super(text);
    this.status = status;
  }
}

export async function ask(path) {
  return answered(await fetch(PREFIX + path));
}

// Ask for what a view shows. What fails is asked for again when the server is back.
export async function learn(asked) {
  try {
    await asked();
  } catch (failure) {
    if (failure instanceof Refused || failure instanceof TypeError) console.info(failure.message);
    else throw failure;
  }
}

export async function send(path, body, method = "POST") {
  const headers = { "Content-Type": "application/json", "X-CSRF-Token": me.csrf_token };
  return answered(await fetch(PREFIX + path, { method, headers, body: JSON.stringify(body) }));
}

export async function learnWhoIAm() {
  me = await ask("/me");
  return me;
}

async function answered(response) {
  const body = await response.json().catch(() => ({}));
  if (!response.ok) throw new Refused(response.status, body.error || `the server answered with status ${response.status}`);
  return body;
}

// Events of the site, and the samples of one fan if its name is given. on: a handler for each kind of event, and
// `connected` with whether the server is there, and `refused` when one has to log in first.
export class Events {
  constructor(on) {
    this.on = on;
    this.fan = "";
    this.source = null;
    this.timer = 0;
  }

  open(fan = "") {
    this.close();
    this.fan = fan;
    this.source = new EventSource(`${PREFIX}/events${fan ? `?fan=${encodeURIComponent(fan)}` : ""}`);
    this.source.onopen = () => this.on.connected(true);
    this.source.onerror = () => {
      this.on.connected(false);
      this.close();
      this.timer = setTimeout(() => this.again(), RETRY_MS);
    };
    for (const name of ["fleet", "alarm", "stages", "samples", "missed"]) {
      this.source.addEventListener(name, (event) => this.on[name]?.(JSON.parse(event.data)));
    }
  }

  // A browser does not say why events do not come: the server is away, or it has ended the session.
  async again() {
    const timer = this.timer;
    const mayRead = await learnWhoIAm().then(() => me.may_read, () => true);
    if (timer !== this.timer) return;
    if (mayRead) this.open(this.fan);
    else this.on.refused();
  }

  close() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.source?.close();
    this.source = null;
  }
}
