// The data of one fan over the time that is shown: what the server has of the past, and the samples that have come since.
// Each point that stands for several samples is two rows, their least and their largest value: no spike is lost.

const KEPT_S = 3600;
const HOLE_S = 12;  // without samples for longer, there is a hole in the plots
const CAUSE_COLUMNS = 4;
const WIDE = 1 / 400, ODD = 3;

export class Timeline {
  constructor() {
    Object.assign(this, { past: null, live: { t_s: [] }, names: [] });
  }

  get newest_s() {
    return this.live.t_s.at(-1) ?? this.past?.newest_s ?? 0;
  }

  // An answer to `series`.
  setPast(series) {
    const means = Object.fromEntries(Object.entries(series.columns).map(([name, { mean }]) => [name, mean]));
    const t_s = [], columns = Object.fromEntries(Object.keys(series.columns).map((name) => [name, []]));
    const known = series.t_s.filter((_, i) => series.columns.command.mean[i] !== null || series.columns.measured.mean[i] !== null);
    const half_s = series.bucket_s / 2;
    series.t_s.forEach((at, i) => {
      t_s.push(at, at + half_s);
      for (const [name, { min, max }] of Object.entries(series.columns)) columns[name].push(min[i], max[i]);
    });
    this.past = { ...series, t_s, columns, means, newest_s: known.at(-1) ?? 0 };
    this.names = [...new Set([...this.names, ...Object.keys(columns)])];
  }

  // Samples that have just come; returns whether there is a channel that was not measured before.
  add(samples) {
    const live = this.live, newest = live.t_s.at(-1) ?? -Infinity;
    if (samples.t_s.length && samples.t_s.at(-1) < newest - 10) this.live = { t_s: [] };  // a replay has begun again
    const first = samples.t_s.findIndex((t_s) => t_s > (this.live.t_s.at(-1) ?? -Infinity));
    if (first < 0) return false;
    const into = this.live, had = into.t_s.length;
    const hasHole = had && samples.t_s[first] - into.t_s[had - 1] > HOLE_S;
    const deviation = samples.measured.map((value, i) => (value === null || samples.predicted[i] === null ? null : value - samples.predicted[i]));
    const columns = { ...samples, deviation };
    delete columns.speed_unit;
    for (const name of Object.keys(columns)) into[name] ??= new Array(had).fill(null);
    for (const [name, values] of Object.entries(into)) {
      if (hasHole) values.push(name === "t_s" ? values[had - 1] + HOLE_S / 2 : null);
      if (columns[name]) for (let i = first; i < columns[name].length; i++) values.push(columns[name][i]);
      else for (let i = first; i < samples.t_s.length; i++) values.push(null);
    }
    const old = into.t_s.findIndex((t_s) => t_s > into.t_s.at(-1) - KEPT_S);
    if (old > 2000) for (const values of Object.values(into)) values.splice(0, old);
    const isNew = Object.keys(columns).some((name) => name !== "t_s" && !this.names.includes(name));
    this.names = [...new Set([...this.names, ...Object.keys(columns).filter((name) => name !== "t_s")])];
    return isNew;
  }

  // Rows from one time to another, not many more than points: times, and a column for each name. What lies just outside
  // is there, too, so that lines reach the edges.
  rows(from_s, to_s, points) {
    const past = this.past, liveFrom_s = !past || this.isFine(from_s) ? -Infinity : past.newest_s;
    const out = { t_s: [] };
    for (const name of this.names) out[name] = [];
    if (past && liveFrom_s > -Infinity) {
      const isOdd = this.oddPoints(to_s - from_s);
      for (let i = 0; i < past.t_s.length && past.t_s[i] < liveFrom_s + 1e-6; i++) {
        if (past.t_s[i] < from_s - past.bucket_s * 2 || past.t_s[i] > to_s + past.bucket_s * 2) continue;
        out.t_s.push(past.t_s[i]);
        if (!isOdd(i >> 1)) {
          for (const name of this.names) out[name].push(past.means[name]?.[i >> 1] ?? null);
          i += 1;
          continue;
        }
        for (const name of this.names) out[name].push(past.columns[name]?.[i] ?? null);
      }
    }
    this.addLive(out, Math.max(liveFrom_s, from_s - 2), to_s + 2, (to_s - from_s) / points);
    return out;
  }

  // Which points of the past are drawn by their extremes: all where they are dense; where each is wide on the screen, extremes
  // would be a saw, so only those with a far larger spread than is usual, and the others by their mean.
  oddPoints(shown_s) {
    const { bucket_s, columns } = this.past, deviation = columns.deviation;
    if (bucket_s / shown_s < WIDE) return () => true;
    const spreads = deviation.filter((_, i) => i % 2).map((high, i) => (high === null ? 0 : high - deviation[2 * i]));
    const known = spreads.filter(Boolean).sort((one, other) => one - other), usual = known[known.length >> 1] ?? 0;
    return (point) => spreads[point] > ODD * usual;
  }

  // Whether the live samples reach back as far as what is shown.
  isFine(from_s) {
    return this.live.t_s.length && this.live.t_s[0] <= from_s;
  }

  addLive(out, from_s, to_s, step_s) {
    const { t_s } = this.live, last = out.t_s.at(-1) ?? -Infinity;
    let i = t_s.findIndex((at) => at >= from_s && at > last);
    if (i < 0) return;
    while (i < t_s.length && t_s[i] <= to_s) {
      let end = i + 1;
      while (end < t_s.length && t_s[end] < t_s[i] + step_s) end++;
      const isOne = end === i + 1;
      out.t_s.push(t_s[i]);
      if (!isOne) out.t_s.push(t_s[i] + (t_s[end - 1] - t_s[i]) / 2);
      for (const name of this.names) {
        const values = this.live[name];
        if (isOne) { out[name].push(values?.[i] ?? null); continue; }
        let low = null, high = null;
        for (let at = i; values && at < end; at++) {
          const value = values[at];
          if (value === null) continue;
          if (low === null || value < low) low = value;
          if (high === null || value > high) high = value;
        }
        out[name].push(low, high);
      }
      i = end;
    }
  }

  // How probable each cause is over time, as steps, the most probable ones; null: there is none.
  causes(steps, to_s) {
    const best = new Map();
    for (const step of steps) for (const [name, value] of Object.entries(step.probabilities)) best.set(name, Math.max(value, best.get(name) ?? 0));
    const names = [...best].sort((one, other) => other[1] - one[1]).slice(0, CAUSE_COLUMNS).map(([name]) => name);
    const last = steps.at(-1);
    const all = last && last.t_s < to_s ? [...steps, { ...last, t_s: to_s }] : steps;
    const isOver = (step) => Object.keys(step.probabilities).length === 0;
    return { names, t_s: all.map((step) => step.t_s), columns: names.map((name) => all.map((step) => (isOver(step) ? null : step.probabilities[name] ?? 0))) };
  }
}
