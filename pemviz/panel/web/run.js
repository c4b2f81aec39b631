// One run: the answer in a strip, the scene with its timeline, the ranked rollouts beside it.
import { html, useCallback, useEffect, useLayoutEffect, useRef, useState } from "/vendor/htm-preact.js";
import * as address from "/address.js";
import { ask, token } from "/talk.js";
import { Charts, Timeline } from "/timeline.js";
import { download } from "/save.js";

const PAGES = [
  ["rollouts", "Rollouts"], ["uncertainty", "Uncertainty"], ["learning", "Learning"],
  ["weights", "Weights"], ["why", "Why"], ["metrics", "Metrics"], ["next", "Measure next"], ["record", "Record"],
];
const AMONG = [["carrying", "what carries the answer"], ["all", "all rollouts"]];
const FIRST = [["share", "largest contribution"], ["least robust", "least robust"]];
const FILES = ["result.json", "ranking.csv", "config.toml", "rollouts.npz", "run.rrd"];
const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
const ROWS = 50;
const LOWEST_PX = 240;
const BESIDE_PX = 450;  // of the window, around the signals that stand in the place of a scene
const VISER = "[data-floating-window],[data-dock-area],.mantine-Paper-root,.mantine-Affix-root,.mantine-Notifications-root{display:none!important}";

const ranked = (at) => Math.max(1, Math.round(Number(at.rank)) || 1);

export function Run({ name, at, state, dark, connected, tell }) {
  const [run, setRun] = useState(null);
  const [rows, setRows] = useState(null);
  const [rollout, setRollout] = useState(null);
  const [step, setStep] = useState(0);
  const [playing, setPlaying] = useState(false);
  const [speed, setSpeed] = useState(1);
  const [follow, setFollow] = useState(true);
  const [width, setWidth] = useState(0);
  const [high, setHigh] = useState(innerHeight);
  const charts = useRef(null);
  const asked = useRef(0);
  const now = useRef(0);  // the step shown: a second key may come before what the first changed is drawn
  const page = at.page ?? "rollouts";
  const live = state?.run === name;
  const version = live ? `${state.kept} ${state.running}` : "";
  const set = useCallback((more) => address.write({ ...address.read(), place: "run", name, ...more }, { replace: true }), [name]);

  useEffect(() => {
    ask("open", { run: name }).then((found) => {
      setRun(found);
      ask("verify", { run: name }).catch((error) => { setRun(null); tell(error.message); });
    }, (error) => tell(error.message));
  }, [name, version]);
  useEffect(() => {
    const watch = new ResizeObserver(([entry]) => setWidth(Math.round(entry.contentRect.width)));
    if (charts.current) watch.observe(charts.current);
    return () => watch.disconnect();
  }, [run !== null]);
  useEffect(() => {
    const grown = () => setHigh(innerHeight);
    addEventListener("resize", grown);
    return () => removeEventListener("resize", grown);
  }, []);

  const choice = run && {
    run: name,
    metric: at.metric ?? run.metric,
    rule: at.rule ?? run.rule,
    among: at.among ?? "carrying",
    first: at.first ?? "share",
  };
  const chosen = choice && JSON.stringify(choice);
  const height = run?.scene ? undefined : Math.max(LOWEST_PX, high - BESIDE_PX);
  const rank = ranked(at);
  const start = Math.max(0, Math.floor((rank - 1) / ROWS) * ROWS);

  useEffect(() => {
    if (!chosen) return undefined;
    let over = false;
    const look = () => ask("ranking", { ...JSON.parse(chosen), start, count: ROWS }).then((found) => {
      if (over) return;
      setRows(found);
      if ("of" in found) setTimeout(look, 300);
    }, (error) => tell(error.message));
    look();
    return () => { over = true; };
  }, [chosen, start, version]);

  useEffect(() => {
    if (!chosen || !width || !rows?.count || !connected) return;  // anew for a server that came back
    const mine = ++asked.current;
    const same = rollout?.rank === rank && rollout?.chosen === chosen;
    const wanted = same ? now.current : at.step !== undefined && !rollout ? Number(at.step) : -1;
    ask("rollout", { ...JSON.parse(chosen), rank, width, height, step: wanted }).then((found) => {
      if (mine !== asked.current || !found) return;
      setRollout({ ...found, chosen });
      if (same) return;  // drawn again for another width: the step may have moved meanwhile
      now.current = found.step;
      setStep(found.step);
      setPlaying(false);
    }, (error) => tell(error.message));
  }, [chosen, rank, width, height, rows?.count, connected]);

  const last = rollout ? rollout.states - 1 : 0;
  const to = useCallback((next) => {
    const kept = Math.min(Math.max(next, 0), last);
    now.current = kept;
    setStep(kept);
    ask("step", { step: kept, follow }).catch(() => {});
  }, [last, follow]);
  useEffect(() => {
    if (!playing || !rollout) return undefined;
    const from = now.current >= last ? 0 : now.current;
    const began = performance.now();
    let shown = -1;
    const timer = setInterval(() => {
      const next = Math.min(from + Math.floor(((performance.now() - began) / 1000) * speed / rollout.dt_s), last);
      if (next !== shown) to(next);
      shown = next;
      if (next === last) setPlaying(false);
    }, 40);
    return () => clearInterval(timer);
  }, [playing, speed, rollout]);
  useEffect(() => {
    if (playing || !rollout) return undefined;
    const timer = setTimeout(() => set({ step }), 200);
    return () => clearTimeout(timer);
  }, [step, playing, rollout]);
  useEffect(() => { if (rollout) to(now.current); }, [follow]);

  const keepScene = () => ask("scene_page", { ...choice, rank }).then(
    (page) => download(`${name}-rank${rank}.html`, new Blob([page], { type: "text/html" })), (error) => tell(error.message));
  const share = last ? step / last : 0;
  const view = at.view ?? "from behind";
  const look = () => {
    const next = view === "from behind" ? "from above" : "from behind";
    set({ view: next });
    ask("look", { move: true, view: next, dark });
  };
  const pick = (next) => set({ rank: Math.min(Math.max(next, 1), rows?.count ?? 1), step: "" });
  const move = (next) => { setPlaying(false); to(next); };
  const by = (steps) => move(now.current + steps);
  const jump = (places, forward) => {
    const found = forward ? places.find((one) => one > now.current) : places.findLast((one) => one < now.current);
    if (found !== undefined) move(found);
  };
  useLayoutEffect(() => {  // no key is lost between what is drawn and what hears of it
    const typed = (event) => {
      if (event.target.closest("input, textarea, select") || event.ctrlKey || event.metaKey || !rollout) return;
      const steps = event.shiftKey ? 10 : 1;
      const act = {
        ArrowLeft: () => by(-steps),
        ArrowRight: () => by(steps),
        ArrowUp: () => pick(ranked(address.read()) - 1),
        ArrowDown: () => pick(ranked(address.read()) + 1),
        " ": () => setPlaying(!playing),
        m: () => jump(rollout.misses, true),
        M: () => jump(rollout.misses, false),
        c: () => rollout.contact !== null && move(rollout.contact),
        v: look,
      }[event.key];
      if (act) { event.preventDefault(); act(); }
    };
    addEventListener("keydown", typed);
    return () => removeEventListener("keydown", typed);
  });

  if (!run) return html`<main class="page"><p class="quiet">Opening ${name} ...</p></main>`;
  return html`<main class="run">
    <${Strip} run=${run} set=${set} />
    <section class="look" data-of=${`${name}-rank${rollout?.rank}`}>
      ${run.scene ? html`<${Scene} />`
        : html`<div class="signals" role="group" aria-label="Signals">${rollout && html`<${Charts} charts=${rollout.stage} share=${share} />`}</div>`}
      ${rollout ? html`
        <div class="moves"><${Timeline} chart=${(run.scene ? rollout.charts : rollout.stage)[0]} rollout=${rollout} step=${step} to=${move} />
        <div class="bar controls">
          <button aria-label="A step back" onClick=${() => by(-1)}>\u25c2</button>
          <button class="main" onClick=${() => setPlaying(!playing)}>${playing ? "Pause" : "Play"}</button>
          <button aria-label="A step ahead" onClick=${() => by(1)}>\u25b8</button>
          <select aria-label="Speed" value=${speed} onChange=${(event) => setSpeed(Number(event.target.value))}>
            ${SPEEDS.map((value) => html`<option value=${value}>${value}x</option>`)}</select>
          <button disabled=${!rollout.misses.length} onClick=${() => jump(rollout.misses, false)}>\u25c2 miss</button>
          <button disabled=${!rollout.misses.length} onClick=${() => jump(rollout.misses, true)}>miss \u25b8</button>
          <button disabled=${rollout.contact === null} onClick=${() => move(rollout.contact)}>contact</button>
          <span class="key"><i class="miss"></i>missed <i class="hit"></i>detected</span>
          <span class="grow"></span>
          ${run.scene && html`<label><input type="checkbox" checked=${follow} onChange=${(event) => setFollow(event.target.checked)} /> follow</label>
          <button title="Seen from behind or from above (v)" onClick=${look}>view: ${view}</button>`}
        </div>
        <p class="values" data-step=${step} data-rank=${rollout.rank}>${(step * rollout.dt_s).toFixed(2)} s: ${
          rollout.readings.map(({ name: what, unit, values }) => `${what} ${reading(values[step] ?? 0)}${unit && ` ${unit}`}, `)}${rollout.words[step]}</p></div>` : html`<p class="quiet">${rows?.count === 0 ? "No rollouts yet." : "Looking ..."}</p>`}
      <div ref=${charts} class="charts">${rollout && html`<${Charts} charts=${rollout.charts} share=${share} />`}</div>
      ${run.scene && html`<p class="bar"><span class="grow"></span><button title="A page that plays the scene without a server" onClick=${keepScene}>3D page</button></p>`}
      <details class="quiet"><summary>${run.scene ? "What the scene shows" : "What is shown"}</summary>${run.scene_words}</details>
    </section>
    <aside data-of=${page === "rollouts" ? `${name}-rank${rollout?.rank}` : name}>
      <nav aria-label="Pages of the run">${PAGES.map(([key, words]) => html`<a href="#" aria-current=${page === key ? "page" : undefined}
        onClick=${(event) => { event.preventDefault(); set({ page: key === "rollouts" ? "" : key }); }}>${words}</a>`)}</nav>
      ${page === "rollouts"
        ? html`<${Ranking} run=${run} choice=${choice} rows=${rows} rank=${rank} pick=${pick} set=${set} rollout=${rollout} start=${start} />`
        : html`<${Page} name=${name} page=${page} version=${version} tell=${tell} set=${set} shown=${rollout?.row.index} />`}
    </aside>
  </main>`;
}

function Strip({ run, set }) {
  const { summary } = run;
  const [open, setOpen] = useState(false);
  const again = html`<a class="tag" href=${`#/new?from=${encodeURIComponent(run.name)}`}>Run again with changes</a>`;
  if (!summary.headline) return html`<section class="strip"><div class="facts">${run.name}: ${summary.sampling} <span class="grow"></span>${again}</div></section>`;
  const doubts = summary.warnings.length;
  return html`<section class="strip" aria-label="Answer">
    <div class="bar top"><span class="answer">${summary.headline}</span>${again}</div>
    <div class="facts">${summary.act_on && html`<b>To act on: ${summary.act_on}</b>`}
      ${summary.decided_by && html`<span class="tag">decided by ${summary.decided_by}</span>`}
      <span class=${summary.sampling_holds ? "yes" : "no"}>${summary.sampling_holds ? "\u2713 sampling ok" : "\u2717 sampling does not hold"}</span>
      ${summary.target && html`<span class="tag">${summary.target}</span>`}
      ${doubts > 0 && html`<button class="link" aria-expanded=${open} onClick=${() => setOpen(!open)}>${doubts} warning${doubts > 1 ? "s" : ""} ${open ? "\u25b4" : "\u25be"}</button>`}
      <span class="grow"></span><span class="quiet">${run.name}, ${summary.method}, ${run.simulated.toLocaleString("en")} rollouts</span>
      <a class="tag" href=${`/files/${encodeURIComponent(run.name)}/result.json`} download>result.json</a>
      <a class="tag" href=${`/files/${encodeURIComponent(run.name)}/ranking.csv`} download>ranking.csv</a>
    </div>
    ${open && html`<ul class="warnings">${summary.warnings.map((text) => html`<li>${text}</li>`)}</ul>`}
  </section>`;
}

function Scene() {
  const hide = (event) => {
    const style = event.target.contentDocument.createElement("style");
    style.textContent = VISER;
    event.target.contentDocument.head.append(style);
    // keys that are pressed after the scene was turned are meant for the page all the same
    event.target.contentWindow.addEventListener("keydown", ({ key, shiftKey, ctrlKey, metaKey }) =>
      document.body.dispatchEvent(new KeyboardEvent("keydown", { key, shiftKey, ctrlKey, metaKey, bubbles: true })));
  };
  return html`<iframe class="scene" title="Scene" src=${`/scene/${token}`} onLoad=${hide}></iframe>`;
}

const reading = (value) => (Math.abs(value) < 1000 ? value.toPrecision(3) : value.toFixed(0)).replace("-", "\u2212");
const number = (value) => (value == null ? "\u2013" : Math.abs(value) >= 0.01 && Math.abs(value) < 1000 || value === 0
  ? value.toFixed(3) : value.toPrecision(3)).replace("-", "\u2212");
const part = (share) => (!share ? "" : share < 1e-4 ? "< 0.01 %" : `${(100 * share).toPrecision(2)} %`);

function Ranking({ run, choice, rows, rank, pick, set, rollout, start }) {
  const select = (key, options) => html`<select aria-label=${key} value=${choice[key]}
    onChange=${(event) => set({ [key]: event.target.value, rank: "", step: "" })}>
    ${options.map(([value, words]) => html`<option value=${value}>${words}</option>`)}</select>`;
  const same = (values) => values.map((value) => [value, value]);
  const ruled = run.rules.length > 0;
  const shown = rows?.rows ?? [];
  return html`<div class="ranking">
    <div class="bar"><label>ranked by ${select("metric", same(run.metrics))}</label>
      <label>among ${select("among", AMONG)}</label><label>first ${select("first", FIRST)}</label>
      ${ruled && html`<label>rule ${select("rule", same(run.rules))}</label>`}</div>
    ${rows && "of" in rows && html`<p class="quiet">Scored so far: ${rows.scored.toLocaleString("en")} of ${rows.of.toLocaleString("en")} rollouts.</p>`}
    <div class="scroll"><table aria-label="Ranking"><thead><tr>
      <th class="n">rank</th><th class="n">robustness${run.metric_unit ? ` [${run.metric_unit}]` : ""}</th><th>${ruled ? "breaks" : "violates"}</th>
      <th class="n">of the answer</th><th class="n">misses</th><th class="n">log weight</th><th class="n">stage</th></tr></thead>
      <tbody>${shown.map((row) => html`<tr key=${row.rank} aria-selected=${row.rank === rank} onClick=${() => pick(row.rank)}>
        <td class="n">${row.rank}</td><td class="n">${number(row.robustness)}</td>
        <td>${ruled ? (row.broken.length ? html`<span title=${row.broken.join(", ")}><b class="no">\u2716</b> ${row.broken.length > 1 ? `${row.broken.length} of ${run.rules.length - 1}` : row.broken[0]}</span>` : "none") : row.violated ? html`<b class="no">\u2716 yes</b>` : "no"}</td>
        <td class="n">${part(row.share)}</td><td class="n">${row.misses}</td>
        <td class="n">${number(row.log_weight)}</td><td class="n">${row.stage}</td></tr>`)}</tbody></table></div>
    ${rows?.count > 0 && html`<p class="quiet bar"><span>${start + 1} to ${Math.min(start + ROWS, rows.count)} of ${rows.count.toLocaleString("en")}${
        rows.among === "carrying" ? " that carry the answer" : ""}</span><span class="grow"></span>
      <button disabled=${start === 0} onClick=${() => pick(start - ROWS + 1)}>\u25c2 before</button>
      <button disabled=${start + ROWS >= rows.count} onClick=${() => pick(start + ROWS + 1)}>after \u25b8</button></p>`}
    ${rollout && html`<div dangerouslySetInnerHTML=${{ __html: rollout.details }}></div>`}
  </div>`;
}

function Page({ name, page, version, tell, set, shown }) {
  const [content, setContent] = useState(null);
  const holder = useRef(null);
  useEffect(() => setContent(null), [name, page]);
  useEffect(() => {
    let over = false;
    const look = () => ask("page", { run: name, page }).then((found) => {
      if (over) return;
      setContent(found.html);
      if (found.waits) setTimeout(look, 500);
    }, (error) => tell(error.message));
    look();
    return () => { over = true; };
  }, [name, page, version]);
  useEffect(() => {
    holder.current?.querySelectorAll("g[data-number]").forEach((one) => one.classList.toggle("shown", Number(one.dataset.number) === shown));
  });
  const clicked = (event) => {
    const one = event.target.closest("[data-number]");
    const target = one?.closest("[data-target]")?.dataset.target;
    if (target) ask("pick", { run: name, target, number: Number(one.dataset.number) }).then(
      (found) => found && set({ ...found, step: "", page: "" }), (error) => tell(error.message));
  };
  if (content === null) return html`<p class="quiet">...</p>`;
  return html`<div>${page === "record" && html`<p>Files: ${FILES.map((file) => html`<a class="tag" download
      href=${`/files/${encodeURIComponent(name)}/${file}`}>${file}</a> `)}</p>`}
    <div ref=${holder} class="pemviz document" onClick=${clicked} dangerouslySetInnerHTML=${{ __html: content }}></div></div>`;
}
