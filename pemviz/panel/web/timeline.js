// When perception missed and what happened, and the charts that share this time.
import { html, useRef } from "/vendor/htm-preact.js";

const ROOM = 0.15;

export function Timeline({ chart, rollout, step, to }) {
  const bar = useRef(null);
  const last = rollout.states - 1;
  const at = (place) => `${(100 * place) / Math.max(last, 1)}%`;
  const drag = (event) => {
    if (event.type === "pointerdown") event.target.setPointerCapture?.(event.pointerId);
    if (event.type === "pointermove" && !event.buttons) return;
    const box = bar.current.getBoundingClientRect();
    to(Math.round(((event.clientX - box.left) / box.width) * last));
  };
  const events = [["contact", rollout.contact], ["first miss", rollout.misses[0]], ["last miss", rollout.misses.at(-1)]]
    .filter(([, place]) => place != null)
    .filter(([, place], rank, all) => all.slice(0, rank).every(([, other]) => Math.abs(place - other) > ROOM * last));  // words side by side
  return html`<div class="timeline" style=${{ marginLeft: `${100 * chart.left}%`, width: `${100 * (chart.right - chart.left)}%` }} ref=${bar} role="slider" tabindex="0" aria-label="Step" aria-valuemin="0"
      aria-valuemax=${last} aria-valuenow=${step} onPointerDown=${drag} onPointerMove=${drag}>
    ${rollout.detections.map((place) => html`<i class="hit" style=${{ left: at(place) }}></i>`)}
    ${rollout.misses.map((place) => html`<i class="miss" style=${{ left: at(place) }}></i>`)}
    ${rollout.contact !== null && html`<i class="contact" style=${{ left: at(rollout.contact) }}></i>`}
    ${events.map(([words, place]) => html`<span class=${place > last / 2 ? "event left" : "event"} style=${{ left: at(place) }}>${words}</span>`)}
    <b style=${{ left: at(step) }}></b>
  </div>`;
}

export function Charts({ charts, share }) {
  return charts.map((chart, place) => html`<div class="chart" key=${place}>
    <div dangerouslySetInnerHTML=${{ __html: chart.html }}></div>
    <b style=${{ left: `${100 * (chart.left + share * (chart.right - chart.left))}%`, top: `${chart.top}px`, height: `${chart.bottom - chart.top}px` }}></b></div>`);
}
