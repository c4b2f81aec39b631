// The page: where one is, what is under way, and the place itself.
import { html, render, useEffect, useLayoutEffect, useState } from "/vendor/htm-preact.js";
import * as address from "/address.js";
import { listen, ask } from "/talk.js";
import { Runs } from "/runs.js";
import { Run } from "/run.js";
import { NewRun, left } from "/new_run.js";

const KEYS = [
  ["1, 2, 3", "Runs, Run, New run"],
  ["/", "search the runs"],
  ["up, down", "rollout before, after"],
  ["left, right", "a step back, ahead; with Shift ten"],
  ["space", "play, pause"],
  ["m, M", "next miss, the one before"],
  ["c", "contact"],
  ["v", "seen from behind, from above"],
  ["Ctrl Enter", "in New run: run it"],
  ["d", "light, dark"],
  ["?", "this list"],
];

function App() {
  const [at, setAt] = useState(address.read());
  const [state, setState] = useState(null);
  const [connected, setConnected] = useState(true);
  const [wrong, setWrong] = useState("");
  const [help, setHelp] = useState(false);
  const [theme, setTheme] = useState(localStorage.getItem("theme") ?? "");
  const prefers = matchMedia("(prefers-color-scheme: dark)");
  const dark = theme ? theme === "dark" : prefers.matches;

  useEffect(() => {
    const moved = () => setAt(address.read());
    addEventListener("hashchange", moved);
    addEventListener("popstate", moved);
    return listen((news) => {
      if ("state" in news) setState(news.state);
      else setConnected(news.connected);
    });
  }, []);
  useEffect(() => {
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    ask("look", { dark }).catch(() => {});
  }, [dark, connected]);
  useEffect(() => {
    document.title = at.name ? `${at.name} - pemviz` : "pemviz";
    setWrong("");
  }, [at.place, at.name]);

  const turn = () => {
    const next = dark ? "light" : "dark";
    localStorage.setItem("theme", next);
    setTheme(next);
  };
  const go = (place, name) => address.write({ place, name });
  useLayoutEffect(() => {
    const typed = (event) => {
      if (event.target.closest("input, textarea, select") || event.ctrlKey || event.metaKey) return;
      const act = {
        1: () => go("runs"),
        2: () => go("run", at.name || state?.run),
        3: () => { location.hash = left.hash; },
        "?": () => setHelp((shown) => !shown),
        d: turn,
        Escape: () => setHelp(false),
      }[event.key];
      if (act) act();
    };
    addEventListener("keydown", typed);
    return () => removeEventListener("keydown", typed);
  });

  const place = ["runs", "run", "new"].includes(at.place) ? at.place : state?.run ? "run" : "runs";
  const name = at.place === "run" && at.name ? at.name : state?.run;
  const tabs = [["runs", "Runs"], ["run", "Run"], ["new", "New run"]];
  return html`
    <header>
      <strong>pemviz</strong>
      <nav aria-label="Places">
        ${tabs.map(([key, words]) => html`<a href=${key === "run" && name ? `#/run/${encodeURIComponent(name)}` : key === "new" ? left.hash : `#/${key}`}
          aria-current=${place === key ? "page" : undefined}>${words}</a>`)}
      </nav>
      <div class="grow" role="status">
        ${connected ? html`${state?.running && html`<progress value=${state.share ?? undefined} max="1"></progress> ${state.words}
          <button onClick=${() => ask("stop")} disabled=${state.stopping}>Stop</button>`}` : "The server is not reached; trying again."}
      </div>
      <button title="Keys (?)" onClick=${() => setHelp(!help)}>?</button>
      <button title="Light or dark (d)" onClick=${turn}>${dark ? "light" : "dark"}</button>
    </header>
    ${(wrong || state?.error) && html`<div class="wrong" role="alert">${wrong || state.error}</div>`}
    ${place === "runs" && html`<${Runs} at=${at} state=${state} tell=${setWrong} />`}
    ${place === "run" && (name
      ? html`<${Run} key=${name} name=${name} at=${{ ...at, place: "run", name }} connected=${connected} state=${state} dark=${dark} tell=${setWrong} />`
      : html`<main class="page"><p>No run yet. <a href="#/new">Set one up.</a></p></main>`)}
    ${place === "new" && html`<${NewRun} at=${at} state=${state} tell=${setWrong} />`}
    ${help && html`<dialog open aria-label="Keys"><h2>Keys</h2><table>${KEYS.map(([key, words]) =>
      html`<tr><th>${key}</th><td>${words}</td></tr>`)}</table><button onClick=${() => setHelp(false)}>Close</button></dialog>`}`;
}

render(html`<${App} />`, document.body);
