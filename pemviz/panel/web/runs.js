// All runs in a table: sorted, filtered, ticked; a click opens one.
import { html, useEffect, useMemo, useRef, useState } from "/vendor/htm-preact.js";
import * as address from "/address.js";
import { ask } from "/talk.js";

const COLUMNS = [
  ["scenario", "scenario", (row) => row.scenario],
  ["detector", "detector, memory", (row) => row.detector],
  ["probability", "probability", (row) => row.probability ?? -1],
  ["high", "to act on", (row) => row.high ?? -1],
  ["decided_by", "decided by", (row) => row.decided_by],
  ["sampling", "sampling", (row) => (row.sampling_holds ? 0 : 1)],
  ["warnings", "warnings", (row) => row.warnings.length],
  ["rollouts", "rollouts", (row) => row.rollouts],
  ["status", "status", (row) => row.status],
  ["name", "name, note", (row) => row.name],
];
const short = (value) => (value == null ? "\u2013" : value === 0 ? "0" : value.toPrecision(2));

const SIGNS = { yes: "\u2713", no: "\u2717", open: "?" };

export function Runs({ at, state, tell }) {
  const [found, setFound] = useState(null);
  const [ticked, setTicked] = useState(new Set());
  const [gone, setGone] = useState([]);
  const [budgets, setBudgets] = useState([]);
  const search = useRef(null);
  const load = () => {
    ask("runs").then(setFound, (error) => tell(error.message));
    ask("budgets").then(setBudgets, (error) => tell(error.message));
  };
  useEffect(() => void load(), [state?.finished, state?.run, state?.running]);
  useEffect(() => {
    const typed = (event) => {
      if (event.key !== "/" || event.target.closest("input, textarea")) return;
      event.preventDefault();
      search.current.focus();
    };
    addEventListener("keydown", typed);
    return () => removeEventListener("keydown", typed);
  }, []);

  const sort = at.sort ?? "name";
  const down = (at.down ?? "1") === "1";
  const words = (at.find ?? "").toLowerCase().split(/\s+/).filter(Boolean);
  const rows = useMemo(() => {
    const shown = (found?.rows ?? []).filter((row) => {
      const text = JSON.stringify(row).toLowerCase();
      return words.every((word) => text.includes(word));
    });
    const value = COLUMNS.find(([key]) => key === sort)?.[2] ?? COLUMNS.at(-1)[2];
    const sign = down ? -1 : 1;
    return shown.sort((a, b) => (value(a) < value(b) ? -sign : value(a) > value(b) ? sign : 0));
  }, [found, sort, down, at.find]);

  const set = (more) => address.write({ ...at, place: "runs", ...more }, { replace: true });
  const tick = (name) => {
    const next = new Set(ticked);
    next.has(name) ? next.delete(name) : next.add(name);
    setTicked(next);
  };
  const remove = async () => {
    const names = [...ticked].filter((name) => found.rows.some((row) => row.name === name && row.kept));
    try {
      await ask("delete", { runs: names });
      setGone(names);
      setTicked(new Set());
    } catch (error) {
      tell(error.message);
    }
    load();
  };
  const undo = async () => {
    await ask("put_back", { runs: gone }).catch((error) => tell(error.message));
    setGone([]);
    load();
  };
  const note = async (row) => {
    const text = prompt(`Note of ${row.name}`, row.note);
    if (text === null) return;
    await ask("note", { run: row.name, text }).catch((error) => tell(error.message));
    load();
  };
  const view = (row) => {  // opened at the click itself: a browser refuses a window that comes later
    const opened = window.open("about:blank");
    ask("viewer", { run: row.name }).then((there) => { opened.opener = null; opened.location = there; },
      (error) => { opened.close(); tell(error.message); });
  };
  if (!found) return html`<main class="page"><p class="quiet">Reading the runs ...</p></main>`;
  return html`<main class="page">
    <div class="bar">
      <input type="search" ref=${search} placeholder="Search: words that a run must have ( / )" aria-label="Search the runs"
        value=${at.find ?? ""} onInput=${(event) => set({ find: event.target.value })} />
      <span class="quiet">${rows.length} of ${found.rows.length} runs in ${found.folder}</span>
      <span class="grow"></span>
      <button disabled=${ticked.size < 2 || ticked.size > 6} title="Two to six runs beside each other"
        onClick=${() => set({ compare: [...ticked].join(" ") })}>Compare</button>
      <button disabled=${!ticked.size} onClick=${remove}>Delete ${ticked.size || ""}</button>
      ${gone.length > 0 && html`<button onClick=${undo}>Undo: bring back ${gone.length}</button>`}
    </div>
    ${found.damaged.map((text) => html`<p class="wrong">${text}</p>`)}
    ${budgets.map((one) => html`<details key=${one.name} class="budget"><summary>
      <span class=${one.mark}>${SIGNS[one.mark]}</span> Risk budget ${one.name}: <span class=${one.mark}>${one.verdict}</span></summary>
      <div class="pemviz document" dangerouslySetInnerHTML=${{ __html: one.page }}></div></details>`)}
    <div class="scroll"><table class="runs" aria-label="Runs">
      <thead><tr><th><input type="checkbox" aria-label="Tick all" checked=${rows.length > 0 && ticked.size === rows.length}
        onChange=${(event) => setTicked(new Set(event.target.checked ? rows.map((row) => row.name) : []))} /></th>
        ${COLUMNS.map(([key, head]) => html`<th aria-sort=${sort === key ? (down ? "descending" : "ascending") : undefined}>
          <button class="head" onClick=${() => set({ sort: key, down: sort === key && down ? "0" : "1" })}>${head}${
            sort === key ? (down ? " \u25be" : " \u25b4") : ""}</button></th>`)}<th></th></tr></thead>
      <tbody>${rows.map((row) => html`<tr key=${row.name} onClick=${(event) => {
          if (!event.target.closest("input, button, a")) address.write({ place: "run", name: row.name });
        }}>
        <td>${html`<input type="checkbox" aria-label=${`Tick ${row.name}`} checked=${ticked.has(row.name)}
          onChange=${() => tick(row.name)} />`}</td>
        <td>${row.scenario}</td><td>${row.detector}</td>
        <td class="n" title=${row.headline}>${row.rule ? html`<span class="quiet">${row.rule}</span> ` : ""}${row.failures === 0 ? "none seen" : short(row.probability)}</td>
        <td class="n">${(row.act_on || "\u2013").split(/ (?=\()/).map((part) => html`<span class="whole">${part}</span> `)}</td><td>${row.decided_by}</td>
        <td>${row.sampling_holds ? html`<span class="yes">\u2713 holds</span>` : html`<span class="no">\u2717 ${row.probability == null ? "no estimate" : "does not hold"}</span>`}</td>
        <td class="n" title=${row.warnings.join("\n")}>${row.warnings.length || ""}</td>
        <td class="n">${row.rollouts.toLocaleString("en")}</td><td title=${row.message}>${row.status}</td>
        <td><a href=${`#/run/${encodeURIComponent(row.name)}`}>${row.name}</a><br /><span class="quiet">${row.note}</span></td>
        <td>${row.kept && html`<button title="Write a note" onClick=${() => note(row)}>note</button>`}
          ${row.recording && html`<button title="The recording in rerun's viewer, in a new tab" onClick=${() => view(row)}>rerun</button>`}</td>
      </tr>`)}</tbody></table></div>
    ${at.compare && html`<${Compare} key=${at.compare} names=${at.compare.split(" ")} close=${() => set({ compare: "" })} tell=${tell} />`}
    ${!rows.length && html`<p class="quiet">${found.rows.length ? "No run has these words." : html`No runs yet. <a href="#/new">Set one up.</a>`}</p>`}
  </main>`;
}

function Compare({ names, close, tell }) {
  const [content, setContent] = useState("");
  useEffect(() => void ask("compare", { runs: names }).then(setContent, (error) => { close(); tell(error.message); }), []);
  return html`<section class="compare" aria-label="Compared runs" data-of=${names.join("-")}><p class="bar"><b>${names.length} runs beside each other</b><span class="grow"></span>
    <button onClick=${close}>Close</button></p><div class="pemviz document" dangerouslySetInnerHTML=${{ __html: content }}></div></section>`;
}
