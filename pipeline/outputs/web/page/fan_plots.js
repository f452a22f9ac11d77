// Which plots a fan has, what each is for, and which lines are in it.

const COLORS = ["cause-1", "cause-2", "cause-3", "cause-4"];
const sum = (one, other, sign) => one.map((value, i) => (value === null || other[i] === null ? null : value + sign * other[i]));

// names: of the columns that there are. causes: those that an alarm in the time shown may have. `data` of each makes its
// times and columns of the rows.
export function plotsOf(names, channels, unit, causes) {
  return [
    {
      title: "Speed", unit, height: 260, leastReach: 0.03,
      help: "The twin is what a healthy fan would do on the same commands.",
      lines: [{ label: "measured", color: "measured" }, { label: "twin", color: "twin", dash: [6, 4] },
        { label: "band of a healthy fan", color: "band", isArea: true, isEdge: true, between: [3, 2] }, { color: "band", isEdge: true }],
      areas: [[2, 3, "band"]],
      data: (rows) => [rows.t_s, [rows.measured, rows.predicted, sum(rows.predicted, rows.half_width, 1), sum(rows.predicted, rows.half_width, -1)]],
    },
    {
      title: "Deviation: measured minus twin", unit, height: 190,
      help: "The limit is on how far the fan deviates and how long, so it is not a speed: see below. Shaded: an alarm.",
      lines: [{ label: "deviation", color: "measured" }, { label: "band of a healthy fan", color: "band", isArea: true, isEdge: true, between: [2, 1] }, { color: "band", isEdge: true },
        { label: "over the alarm limit", color: "exceeds", isArea: true, isPlain: true, isEdge: true }, { color: "exceeds", isEdge: true }],
      areas: [[1, 2, "band"], [3, 1, "exceeds"], [2, 4, "exceeds"]],
      data: (rows) => {
        const half = rows.half_width, under = half.map((value) => (value === null ? null : -value));
        const beyond = (edge, better) => rows.deviation.map((value, i) => (edge[i] === null || value === null || !(rows.score[i] > 1) ? edge[i] : better(value, edge[i])));
        return [rows.t_s, [rows.deviation, half, under, beyond(half, Math.max), beyond(under, Math.min)]];
      },
    },
    {
      title: "How near to an alarm", unit: "% of the limit", height: 130, range: [0, 110], lowest: 0,
      help: "What all deviations up to then say together. At 100 % an alarm is raised; a healthy fan hardly ever comes near.",
      lines: [{ label: "score", color: "measured" }, { label: "alarm limit", color: "limit", dash: [3, 4], isPlain: true }, { color: "alarm", isEdge: true }],
      areas: [[2, 1, "exceeds"]],
      data: (rows) => {
        const score = rows.score.map((value) => (value === null ? null : 100 * value));
        return [rows.t_s, [score, rows.t_s.map(() => 100), score.map((value) => (value === null ? null : Math.max(value, 100)))]];
      },
    },
    ...(causes.length ? [{
      title: "Evidence of each cause", unit: "%", height: 150, range: [0, 100], lowest: 0,
      help: "How probable each cause is. It becomes clearer the longer the alarm lasts and the more the command changes.",
      lines: causes.map((name, i) => ({ label: name, color: COLORS[i], isStepped: true })),
      data: (_rows, evidence) => [evidence.t_s, causes.map((name) => {
        const at = evidence.names.indexOf(name);
        return at < 0 ? evidence.t_s.map(() => null) : evidence.columns[at].map((value) => (value === null ? null : 100 * value));
      })],
    }] : []),
    {
      title: "Command", unit: "", height: 140, leastReach: 0.02,
      lines: [{ label: "command", color: "measured" }],
      data: (rows) => [rows.t_s, [rows.command]],
    },
    {
      title: "Torque balance", unit: "", height: 140, range: [-0.01, 0.01],
      help: "How much more command the fan needs for its speed than a healthy one. Above 0, something brakes it or drives it less.",
      lines: [{ label: "excess command", color: "measured" }],
      data: (rows) => [rows.t_s, [rows.torque_balance_command]],
    },
    ...channels.filter((each) => names.includes(each.name)).map((each) => ({
      title: each.title[0].toUpperCase() + each.title.slice(1), unit: each.unit, height: 130, leastReach: 0.02,
      lines: [{ label: each.title, color: "measured" }],
      data: (rows) => [rows.t_s, [rows[each.name]]],
    })),
  ];
}
