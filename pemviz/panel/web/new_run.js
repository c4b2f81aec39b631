// The form for a new run: what is typed stands in the address, and what is wrong at its field.
import { html, useEffect, useMemo, useRef, useState } from "/vendor/htm-preact.js";
import * as address from "/address.js";
import { ask, AWAY } from "/talk.js";

const PAUSE_MS = 150;
const AGAIN_MS = 1000;
const MAIN = [["question", "Question"], ["detector", "Detector"], ["method", "Method"], ["certainty", "Certainty"]];
const OF_SCENARIO = ["question", "scenario", "encounter", "sumo"];
const FILE = "a file ...";
const NOTHING = { wrong: {}, notes: {}, facts: {}, differs: [], understood: "", command: "" };

/** Where the form was left, for the way back to it. */
export const left = { hash: "#/new" };

const base = (at) => (at.from ? { run: at.from } : { preset: at.preset ?? "" });
const id = (key) => `field-${key}`;

/** What was typed, as the address says it: emptied fields are named in one word. */
function typedIn(at, fields) {
  const keys = new Set(fields.map((field) => field.key));
  const emptied = (at.empty ?? "").split(" ").filter((key) => keys.has(key)).map((key) => [key, ""]);
  return Object.fromEntries([...Object.entries(at).filter(([key]) => keys.has(key)), ...emptied]);
}

function addressOf(at, typed) {
  const entries = Object.entries(typed);
  return {
    place: "new", from: at.from, preset: at.preset, advanced: at.advanced,
    ...Object.fromEntries(entries.filter(([, text]) => text !== "")),
    empty: entries.filter(([, text]) => text === "").map(([key]) => key).join(" "),
  };
}

export function NewRun({ at, state, tell }) {
  const [form, setForm] = useState(null);
  const [typed, setTyped] = useState({});
  const [check, setCheck] = useState(NOTHING);
  const [starting, setStarting] = useState(false);
  const [about, setAbout] = useState("rule");
  const newest = useRef(0);
  const building = useRef(Promise.resolve());
  const built = useRef({ wrong: {}, values: {} });
  const begin = JSON.stringify(base(at));

  useEffect(() => {
    let over = false;
    tell("");
    setForm(null);
    setCheck(NOTHING);
    built.current = { wrong: {}, values: {} };
    ask("form", base(at)).then((found) => {
      if (over) return;
      const now = typedIn(at, found.fields);
      setTyped(Object.fromEntries(Object.entries(now).filter(([key, text]) => text !== found.values[key])));
      setForm(found);
    }, (error) => { if (!over) tell(error.message); });
    return () => { over = true; };
  }, [begin]);

  // longer texts than the server reads are told to be too long all the same
  const values = useMemo(() => Object.fromEntries(Object.entries(typed).map(
    ([key, text]) => [key, text.slice(0, (form?.longest ?? 0) + 1)])), [typed, form]);

  useEffect(() => {
    if (!form) return undefined;
    const mine = ++newest.current;
    const isNewest = () => mine === newest.current;
    const asked = { ...JSON.parse(begin), values };
    const look = async () => {
      if (!isNewest()) return;
      address.write(addressOf(address.read(), values), { replace: true });
      left.hash = location.hash;
      try {
        const quick = await ask("check", asked);
        if (!isNewest()) return;
        setCheck({ ...quick, wrong: { ...lasting(built.current, values), ...quick.wrong } });
        if (Object.keys(quick.wrong).length || state?.running) return;
        await building.current;
        if (!isNewest()) return;
        const whole = ask("check", { ...asked, whole: true });
        building.current = whole.catch(() => {});
        const found = await whole;
        built.current = { wrong: found.wrong, values };
        if (isNewest()) setCheck(found);
      } catch (error) {  // the head says where the server is away
        if (error.message === AWAY) setTimeout(look, AGAIN_MS);
        else tell(error.message);
      }
    };
    const timer = setTimeout(look, check === NOTHING ? 0 : PAUSE_MS);
    return () => clearTimeout(timer);
  }, [form, values, state?.running]);

  const set = (key, text) => setTyped((before) => {
    const { [key]: _, ...rest } = before;
    return text === form.values[key] ? rest : { ...rest, [key]: text };
  });
  const choosePreset = (preset) => {
    const group = Object.fromEntries(form.fields.map((field) => [field.key, field.group]));
    const kept = Object.fromEntries(Object.entries(typed).filter(([key]) => !OF_SCENARIO.includes(group[key])));
    address.write(addressOf({ preset, advanced: at.advanced }, kept));
  };
  const show = (key) => {
    if (advanced.some((field) => field.key === key)) address.write({ ...address.read(), advanced: "1" }, { replace: true });
    setTimeout(() => document.getElementById(id(key))?.focus(), 50);
  };
  const run = async () => {
    if (stopped) return;
    setStarting(true);
    tell("");
    try {
      const found = await ask("start", { ...JSON.parse(begin), values });
      if (found.run) return address.write({ place: "run", name: found.run });
      setCheck({ ...check, wrong: found.wrong });
      const key = Object.keys(found.wrong)[0];
      if (key) show(key);
    } catch (error) {
      tell(error.message);
    }
    return setStarting(false);
  };
  useEffect(() => {
    const pressed = (event) => {
      if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) run();
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  });

  if (!form) return html`<main class="page"><p class="quiet">Opening the form ... <a href="#/new">Begin with paper</a></p></main>`;
  const { wrong } = check;
  const hidden = check.hidden ?? form.hidden;
  const seen = form.fields.filter(({ key }) => !hidden.unused.includes(key) || key in typed || key in wrong);
  const isMain = (field) => field.main && !hidden.beside.includes(field.key);
  const advanced = seen.filter((field) => !isMain(field));
  const open = at.advanced === "1" || advanced.some(({ key }) => key in wrong || key in check.notes);
  const mistakes = Object.keys(wrong);
  const links = (keys) => keys.map((key, place) => html`${place > 0 && ", "}${key
    ? html`<button class="link" onClick=${() => show(key)}>${label(key)}</button>` : wrong[key]}`);
  const stopped = state?.running || starting || mistakes.length > 0;
  const one = (field) => html`<${Field} key=${field.key} field=${field} value=${typed[field.key] ?? form.values[field.key]}
    was=${field.key in typed ? form.values[field.key] : null} set=${(text) => set(field.key, text)} wrong=${wrong[field.key]}
    note=${check.notes[field.key]} fact=${check.facts[field.key]} missing=${field.key === "simulator" ? form.missing : {}} />`;
  const label = (key) => form.fields.find((field) => field.key === key)?.label ?? key;
  const told = form.fields.find((field) => field.key === about);

  return html`<main class="new" onfocusin=${(event) => event.target.dataset?.key && setAbout(event.target.dataset.key)}>
    <section class="fields" aria-label="New run">
      ${MAIN.map(([group, words]) => html`<fieldset key=${group}><legend>${words}</legend><div class="grid">
        ${group === "question" && html`<${Scenario} form=${form} at=${at} choose=${choosePreset} />`}
        ${seen.filter((field) => isMain(field) && field.group === group).map(one)}</div></fieldset>`)}
      <details open=${open} onToggle=${(event) => event.target.open !== open
          && address.write({ ...address.read(), advanced: event.target.open ? "1" : "" }, { replace: true })}>
        <summary>Advanced</summary>
        ${open && form.groups.map(([group, words]) => [words, advanced.filter((field) => field.group === group)]).filter(([, fields]) => fields.length).map(
          ([words, fields]) => html`<fieldset key=${words}><legend>${words}</legend><div class="grid">${fields.map(one)}</div></fieldset>`)}
      </details>
    </section>
    <aside class="told">
      ${told && html`<section><h2>${told.label}</h2><p>${told.help}</p></section>`}
      <section aria-label="Differences"><h2>Differs from ${form.name}</h2>
        ${check.differs.length ? html`<table><tbody>${check.differs.map((one) => html`<tr key=${one.key}><th>${one.label}</th>
          <td><s>${brief(one.before)}</s> ${brief(one.after)}</td></tr>`)}</tbody></table>` : html`<p class="quiet">In nothing.</p>`}</section>
      ${check.understood && html`<section><h2>Understood as</h2><p>${check.understood}</p></section>`}
      ${check.command && html`<section><h2>The same on the command line</h2><p><code>${check.command}</code></p>
        <button onClick=${() => navigator.clipboard?.writeText(check.command)}>Copy</button></section>`}
    </aside>
    <div class="act" role="status">
      <button class="main" disabled=${stopped} title="Ctrl Enter" onClick=${run}>Run</button>
      ${state?.running && html`<button disabled=${state.stopping} onClick=${() => ask("stop")}>Stop</button>`}
      <span class="says">${starting ? "Starting ..."
        : mistakes.length ? html`<b class="no">To fix: </b>${links(mistakes)}`
        : Object.keys(check.notes).length ? html`<b>To mind: </b>${links(Object.keys(check.notes))}`
        : state?.running ? html`A run is under way: one at a time. <a href=${`#/run/${encodeURIComponent(state.run ?? "")}`}>See it</a>`
        : check.differs.length ? `Differs from ${form.name}: ${check.differs.map((one) => `${one.label} ${brief(one.after, 24)}`).join("; ")}`
        : `As ${form.name}`}</span>
      ${Object.keys(typed).length > 0 && html`<button onClick=${() => setTyped({})}>Back to ${brief(form.name, 30)}</button>`}
    </div>
  </main>`;
}

/** What only showed once all was built is told until it is built again, but where it was changed. */
const lasting = (built, values) => Object.fromEntries(
  Object.entries(built.wrong).filter(([key]) => values[key] === built.values[key]));

const brief = (text, most = 60) => (text === "" ? "left out" : text.length > most ? `${text.slice(0, most)}...` : text);

function Scenario({ form, at, choose }) {
  const preset = at.from ? "" : form.name;
  const chosen = form.presets.find((one) => one.name === preset);
  return html`<div class="field scenario"><label for=${id("preset")}>Scenario</label>
    <select id=${id("preset")} value=${preset} aria-describedby=${`${id("preset")}-says`} onChange=${(event) => choose(event.target.value)}>
      ${at.from && html`<option value="">as run ${at.from}</option>`}
      ${form.presets.map((one) => html`<option value=${one.name}>${one.name}${one.missing ? " (not installed)" : ""}</option>`)}</select>
    <p class="quiet" id=${`${id("preset")}-says`}>${form.words}</p>
    ${chosen?.missing && html`<p class="error">${chosen.missing}</p>`}</div>`;
}

function Field({ field, value, was, set, wrong, note, fact, missing }) {
  const { key, kind } = field;
  const says = [wrong && "wrong", note && "note", fact && "fact"].filter(Boolean).map((one) => `${id(key)}-${one}`).join(" ");
  const common = {
    id: id(key), "data-key": key, "aria-invalid": wrong ? "true" : undefined, "aria-describedby": says || undefined,
    onInput: (event) => set(event.target.value),
  };
  const plain = { ...common, spellcheck: false, autocomplete: "off", value };
  const input = {
    number: () => html`<input ...${plain} inputmode="decimal" placeholder=${field.may_be_empty ? "left out" : ""} />`,
    text: () => html`<input ...${plain} placeholder=${field.may_be_empty ? "left out" : ""} />`,
    lines: () => html`<textarea ...${plain} rows=${Math.min(Math.max(value.split("\n").length, 1), 6)} placeholder=${field.may_be_empty ? "left out" : ""}></textarea>`,
    switch: () => html`<input ...${common} type="checkbox" checked=${value === "true"} onInput=${(event) => set(event.target.checked ? "true" : "false")} />`,
    choice: () => html`<${Choice} field=${field} value=${value} set=${set} common=${common} missing=${missing} />`,
  }[kind]();
  return html`<div class=${`field ${kind}`} title=${field.help}>
    <label for=${id(key)}>${field.label}${field.unit && html` <span class="quiet">[${field.unit}]</span>`}</label>
    ${was !== null && html`<button class="link was" title="Back to this" onClick=${() => set(was)}>was ${was === "" ? "empty" : brief(was, 16)}</button>`}
    ${input}
    <div aria-live="polite">
      ${wrong && html`<p class="error" id=${`${id(key)}-wrong`}>${wrong}</p>`}
      ${note && html`<p class="note" id=${`${id(key)}-note`}>${note}</p>`}
      ${fact && html`<p class="quiet fact" id=${`${id(key)}-fact`}>${fact}</p>`}</div>
    <p class="help">${field.help}</p></div>`;
}

/** One of some values; where a file may be named too, its path is typed below. */
function Choice({ field, value, set, common, missing }) {
  const known = field.choices.includes(value) || (field.may_be_empty && value === "");
  const [typing, setTyping] = useState(field.open && !known);
  const isFile = field.open && (typing || !known);
  const choose = (event) => {
    const chosen = event.target.value;
    setTyping(chosen === FILE);
    set(chosen === FILE ? "" : chosen);
  };
  return html`<select ...${common} id=${isFile ? `${common.id}-kind` : common.id} aria-label=${isFile ? `${field.label}: which` : undefined}
      value=${isFile ? FILE : value} onInput=${choose}>
      ${field.may_be_empty && html`<option value="">none</option>`}
      ${!known && !field.open && html`<option value=${value}>${value}</option>`}
      ${field.choices.map((one) => html`<option value=${one}>${one}${missing[one] ? " (not installed)" : ""}</option>`)}
      ${field.open && html`<option value=${FILE}>${FILE}</option>`}</select>
    ${isFile && html`<input ...${common} value=${value} spellcheck=${false} autocomplete="off" placeholder="path, where the panel runs" />`}`;
}
