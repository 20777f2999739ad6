// The newest status from the daemon: server-sent events, the age of what is shown, and when it is stale.

export const STALE_S = 4;
const RETRY_S = 2;

class Live extends EventTarget {
  constructor() {
    super();
    this.status = null;
    this.heard_ms = 0;
    this.source = null;
    this.version = null;
    this.tried_ms = 0;
    this.temperatures = false;
  }

  // Whether the temperatures of every cycle are wanted too.
  want(temperatures) {
    if (temperatures === this.temperatures) return;
    this.temperatures = temperatures;
    if (this.source) this.connect();
  }

  start() {
    this.connect();
    setInterval(() => this.watch(), 500);
    document.addEventListener("visibilitychange", () => { if (!document.hidden) this.watch(); });
  }

  connect() {
    this.source?.close();
    this.tried_ms = performance.now();
    this.source = new EventSource(`/api/v1/events${this.temperatures ? "?temperatures=true" : ""}`);
    this.source.addEventListener("status", (event) => this.take(JSON.parse(event.data)));
    this.source.addEventListener("cycle", (event) => this.tell("cycle", JSON.parse(event.data)));
  }

  take(status) {
    const version = `${status.version ?? ""}/${status.schema ?? ""}`;
    if (this.version !== null && version !== this.version) {
      location.reload(); // another daemon: its pages belong to it
      return;
    }
    this.version = version;
    this.status = status;
    this.heard_ms = performance.now();
    this.tell("status", status);
    this.tell("age");
  }

  tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // Age of the status on the screen [s]: since it came, and as old as it was then.
  get age_s() {
    if (this.status === null) return Infinity;
    return (performance.now() - this.heard_ms) / 1000 + (this.status.age_s ?? 0);
  }

  get stale() {
    return (performance.now() - this.heard_ms) / 1000 > STALE_S;
  }

  watch() {
    const waited_s = (performance.now() - Math.max(this.tried_ms, this.heard_ms)) / 1000;
    const closed = this.source?.readyState === EventSource.CLOSED;
    if ((closed && waited_s > RETRY_S) || waited_s > 3 * STALE_S) this.connect();
    this.tell("age");
  }
}

export const live = new Live();
